"""What each command does, on top of the library; `avatar.cli` parses, this acts and talks."""

from __future__ import annotations

import json
import sys
import time
from argparse import Namespace
from importlib import import_module
from pathlib import Path

import torch
from tqdm import tqdm

from avatar.bench import PARTS, Request
from avatar.checkpoint import Checkpoint, newest_checkpoint, read_run_info
from avatar.config import Config, flatten, load_config
from avatar.data.subject import Subject
from avatar.data_prep.prepare import prepare as prepare_folder
from avatar.demo import make_subject
from avatar.doctor import report as report_installation
from avatar.drive import Drive, subject_drive
from avatar.drive_file import read_drive, write_drive
from avatar.errors import UserError
from avatar.evaluation.compare import compare as compare_runs
from avatar.evaluation.compare_tables import FORMATS, write_tables
from avatar.evaluation.evaluate import evaluate
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.expression_names import load_expression_names
from avatar.model import Avatar
from avatar.quality.cost import measure_cost
from avatar.quality.folder import as_text, check_folder
from avatar.reenact import Choices
from avatar.reenact import reenact as drive
from avatar.run import Run, Source, check_same, find_head, load_run, open_subject, read_source, start_run
from avatar.train.trainer import train as run_training

OK, INTERRUPTED = 0, 130


def train(arguments: Namespace) -> int:
    run = arguments.out or Path("runs") / arguments.folder.resolve().name
    overrides = config_overrides(arguments)
    if arguments.resume:
        return resume_training(run, arguments, overrides)
    source = Source(
        arguments.folder,
        find_head(arguments.folder, arguments.head),
        arguments.tracking,
        arguments.frame_offset,
        arguments.format,
    )
    return train_new(source, load_config(overrides), run)


def train_new(source: Source, config: Config, run: Path) -> int:
    subject, assets = open_subject(source, config, print)
    torch.manual_seed(config.trainer.seed)
    avatar = Avatar(assets, subject.identity, config.model)
    start_run(run, source, config, subject)
    return finish_training(avatar, subject, config, run)


def resume_training(run: Path, arguments: Namespace, overrides: list[str]) -> int:
    """Go on from the newest checkpoint, with the configuration and the data that the run began with."""
    checkpoint = newest_checkpoint(run)
    config, source = read_source(run, read_run_info(run), arguments.head)
    if source.folder != arguments.folder.resolve():
        raise UserError(f"{run} was trained on {source.folder}, not on {arguments.folder}; choose another --out")
    if overrides:
        refuse_changes(run, config, overrides)
    subject, assets = open_subject(source, config, print)
    check_same(run, checkpoint, subject, assets)
    if checkpoint.meta.get("threads") != torch.get_num_threads():
        print(
            f"Note: the checkpoint was made with {checkpoint.meta.get('threads')} threads, this machine uses "
            f"{torch.get_num_threads()}; the result is the same to rounding, not to the bit"
        )
    if checkpoint.step >= config.trainer.iterations:
        print(f"{run} is complete ({checkpoint.step} steps). Next: avatar eval {run}")
        return OK
    print(f"Resuming {run} at step {checkpoint.step} of {config.trainer.iterations}")
    avatar = Avatar(assets, subject.identity, config.model)
    return finish_training(avatar, subject, config, run, checkpoint)


def finish_training(
    avatar: Avatar, subject: Subject, config: Config, run: Path, checkpoint: Checkpoint | None = None
) -> int:
    split = subject.split
    print(
        f"Training {len(avatar):,} Gaussians ({config.model.name}) on {len(split.train)} frames of {subject.name}, "
        f"{len(split.test)} held out, {config.trainer.iterations:,} steps"
    )
    begin = time.monotonic()
    done = run_training(avatar, subject, config, run, resume=checkpoint)
    first = checkpoint.step if checkpoint else 0
    seconds = time.monotonic() - begin
    rate = f"{seconds / max(done - first, 1):.3f} s per step"
    if done < config.trainer.iterations:
        print(f"\nInterrupted at step {done} ({rate}); everything up to there is saved in {run}.")
        print("Add --resume to the same command to go on.")
        return INTERRUPTED
    print(f"Trained in {seconds:.0f} s ({rate}).")
    print(f"Checkpoints  {run / 'checkpoints'}")
    print(f"Previews     {run / 'previews'}")
    print(f"Curves       tensorboard --logdir {run / 'tensorboard'}")
    print(f"Next         avatar eval {run}")
    return OK


def config_overrides(arguments: Namespace) -> list[str]:
    """The options that are short forms of configuration keys, before the overrides, so that those win."""
    short = {"data.size": arguments.size, "trainer.iterations": arguments.iterations, "trainer.seed": arguments.seed}
    groups = [o for o in arguments.overrides if "." not in o.partition("=")[0]]
    keys = [o for o in arguments.overrides if o not in groups]
    return [*groups, *(f"{key}={value}" for key, value in short.items() if value is not None), *keys]


def refuse_changes(run: Path, config: Config, overrides: list[str]) -> None:
    """A resumed run keeps its configuration; naming another value for a key is an error, not a silent choice."""
    recorded, asked = flatten(config.to_dict()), flatten(load_config(overrides).to_dict())
    named = {o.partition("=")[0] for o in overrides}
    for key, value in asked.items():
        mentioned = key in named or key.partition(".")[0] in named or "experiment" in named
        if mentioned and recorded[key] != value:
            raise UserError(
                f"{run} began with {key}={recorded[key]}, not {value}: leave the override out to resume, or start a new run"
            )


def compare(arguments: Namespace) -> int:
    comparison = compare_runs(arguments.runs, arguments.protocol)
    if arguments.out is not None:
        write_tables(arguments.out, comparison)
        print(f"Written to {arguments.out}", file=sys.stderr)  # the table may be piped
    _, table = FORMATS[arguments.format]
    print(table(comparison), end="")
    return OK


def eval(arguments: Namespace) -> int:
    run = load_run(arguments.run, arguments.head)
    evaluate(run, arguments.protocol, write_frames=arguments.frames)
    return OK


def report(arguments: Namespace) -> int:
    from avatar.report.page import write_report  # imports matplotlib and tensorboard, which take a second

    print(f"Report {write_report(load_run(arguments.run, arguments.head))}")
    return OK


def reenact(arguments: Namespace) -> int:
    run = load_run(arguments.run, arguments.head)
    if arguments.driver.suffix.lower() in (".npz", ".csv"):
        driver = open_drive_file(arguments.driver, run)
    else:
        tracking, offset, format = arguments.driver_tracking, arguments.frame_offset, arguments.format
        driver = open_driver(arguments.driver, run, arguments.head, tracking, offset, format)
    choices = Choices(
        arguments.transfer, arguments.strength, arguments.smoothing, arguments.camera, arguments.intrinsics
    )
    drive(run, driver, choices, out=arguments.out)
    return OK


def open_drive_file(path: Path, run: Run) -> Drive:
    assets, width = run.avatar.head.assets, run.subject.image_size(run.config.data.size)[0]
    return read_drive(path, assets, load_expression_names(run.source.head, assets.num_expressions), width)


def drive_file(arguments: Namespace) -> int:
    if arguments.out.suffix.lower() != ".npz":
        raise UserError(f"a drive file is written as .npz, not as {arguments.out}")
    head = find_head(arguments.folder, arguments.head)
    source = Source(arguments.folder, head, arguments.tracking, arguments.frame_offset, arguments.format)
    subject, assets = open_subject(source, None, print)
    write_drive(arguments.out, subject_drive(subject, None), assets.fingerprint)
    print(f"{len(subject)} frames written to {arguments.out}")
    return OK


def open_driver(
    folder: Path,
    run: Run,
    head: Path | None = None,
    tracking: Path | None = None,
    offset: int | None = None,
    format: str | None = None,
) -> Subject:
    """The driver with its own head model where it has one, else with the avatar's."""
    own = folder / "head_model"
    path = own if own.is_dir() and head is None else run.source.head
    known: HeadAssets | None = run.avatar.head.assets if path == run.source.head else None
    driver, _ = open_subject(Source(folder, path, tracking, offset, format), None, print, known)
    return driver


def prepare(arguments: Namespace) -> int:
    head = find_head(arguments.folder, arguments.head)
    prepared = prepare_folder(
        arguments.folder,
        load_head_assets(head),
        head,
        tracking=arguments.tracking,
        frame_offset=arguments.frame_offset,
        format=arguments.format,
        out=arguments.out,
    )
    subject = Subject.open(prepared)
    print(
        f"{subject.name}: {len(subject)} frames of {subject.width}x{subject.height}, "
        f"{len(subject.split.train)} to train, {len(subject.split.test)} to test"
    )
    print(f"Prepared in {prepared}")
    return OK


def check(arguments: Namespace) -> int:
    """Exit status 0: fine, 1: warnings, 2: errors."""
    outcome = check_folder(
        arguments.folder,
        lambda: load_head_assets(find_head(arguments.folder, arguments.head)),
        tracking=arguments.tracking,
        frame_offset=arguments.frame_offset,
        format=arguments.format,
        progress=lambda items, total, what: tqdm(items, total=total, desc=what, leave=False),
    )
    print(json.dumps(outcome.to_dict(), indent=1) if arguments.json else as_text(outcome))
    if arguments.out is not None:
        from avatar.quality.page import write_page  # imports matplotlib, which takes half a second

        cost = None
        if outcome.clip is not None and outcome.coverage is not None:
            cost = measure_cost(outcome.clip, outcome.coverage, load_config())
        page = write_page(outcome, cost, arguments.out)
        print(f"Page   {page}", file=sys.stderr if arguments.json else sys.stdout)
    return outcome.status


def demo_data(arguments: Namespace) -> int:
    make_subject(arguments.out, arguments.frames, arguments.size, arguments.seed, arguments.motion)
    print(f"Next   avatar train {arguments.out}")
    return OK


def demo(arguments: Namespace) -> int:
    """The whole program on subjects of its own making."""
    out: Path = arguments.out
    actor, driver, run = out / "actor", out / "driver", out / "run"
    if not actor.is_dir():
        make_subject(actor, 500, 192, 1, "speech")
    if not driver.is_dir():
        make_subject(driver, 100, 192, 2, "speech")
    if not (run / "run.json").is_file():
        status = train_new(Source(actor, actor / "head_model"), load_config(["experiment=demo"]), run)
        if status != OK:
            return status
    trained = load_run(run)
    video = drive(trained, open_driver(driver, trained))
    results = evaluate(trained, None, write_frames=False)
    print("\nThe demo is done. Look at")
    print(f"  {results.parent / 'truth_render_error.mp4'}   held-out frames: truth, render, error")
    print(f"  {video}   another person's motion on the avatar")
    print(f"  {run / 'previews'}   how it got better during training")
    return OK


def bench(arguments: Namespace) -> int:
    out: Path = arguments.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made ({error.strerror}); choose another --out") from error
    request = Request(
        out,
        arguments.quick,
        arguments.full,
        tuple(arguments.inputs),
        tuple(arguments.overrides),
        arguments.head,
        arguments.tracking,
        arguments.frame_offset,
    )
    # Only the part that is asked for is imported.
    import_module(PARTS[arguments.part].module).run(request)
    return OK


def doctor(arguments: Namespace) -> int:
    return report_installation()
