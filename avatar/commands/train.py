"""avatar train: a tracked folder or a video in, a run out; with --refine, training and refinement in turns."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from avatar.commands.outputs import check_run_folder
from avatar.commands.train_view import train_in_view
from avatar.config import MAX_OVERRIDE, check_value, chosen_options, flatten, load_config
from avatar.config_values import shown
from avatar.data.source import Source
from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.files.names import ROUNDS_FOLDER, display_name, safe_name, typed
from avatar.pipeline import OK
from avatar.pipeline.cached_tracking import cached_tracking, head_for_video, is_video
from avatar.pipeline.dry_run import estimate_training
from avatar.pipeline.open_inputs import at_new_place, source_of
from avatar.pipeline.refine_plan import Plan, plan_file
from avatar.pipeline.train import resume_run, train_new
from avatar.pipeline.train_refined import begin_rounds, train_refined
from avatar.runs.run import RUN_FILE, RunInfo, read_run_info, refuse_trained
from data_prep.prepare.wrong_inputs import check_folder

MAX_ROUNDS = 10
SHORT_FORMS = ("data.size", "trainer.iterations", "trainer.seed")  # keys whose last part is an option


def run_train(arguments: Namespace) -> int:
    if arguments.resume and (arguments.print_config or arguments.dry_run):
        option = "--print-config" if arguments.print_config else "--dry-run"
        raise UserError(f"{option} is for a new run: leave --resume out; a run's configuration is in its {RUN_FILE}")
    if arguments.print_config:
        print_config(config_overrides(arguments))
        return OK
    assign_paths(arguments)
    if arguments.dry_run:
        return dry_run(arguments)
    run = arguments.out or default_run(arguments.folder)

    def train() -> int:
        status = train_as_asked(run, arguments)
        print(
            f"Next         avatar eval {typed(run)}" if status == OK else "Add --resume to the same command to go on."
        )
        return status

    return train_in_view(run, arguments.head, train) if arguments.view else train()


def train_as_asked(run: Path, arguments: Namespace) -> int:
    """Train into `run`, or go on with it; the exit status."""
    overrides = config_overrides(arguments)
    has_plan = plan_file(run).exists()
    if arguments.device is not None and (arguments.refine is not None or has_plan):
        overrides.append(f"device={arguments.device}")
    if arguments.resume and has_plan:
        drop_video(arguments)
        plan = Plan.load(run)
        refuse_changed_plan(run, plan, arguments, overrides)
        if (device := asked_device(overrides)) is not None:
            kept = (override for override in plan.overrides if override.partition("=")[0] != "device")
            plan = replace(plan, overrides=(*kept, f"device={device}"))
        source = moved_plan_source(run, plan.source, arguments)
        with locked(run / ROUNDS_FOLDER):
            return train_refined(run, plan, source, time.monotonic() - plan.spent)
    if arguments.minutes is not None and arguments.refine is None:
        raise UserError("--minutes goes with --refine; without it, say --iterations")
    if arguments.resume:
        if arguments.refine is not None:
            raise UserError(f"{run} began without --refine: leave it out to resume, or start a new run")
        drop_video(arguments)
        refuse_changed_run(run, read_run_info(run), arguments, overrides)
        return resume_run(run, arguments.head, arguments.folder, arguments.device or asked_device(overrides))
    begin = time.monotonic()
    load_config(overrides)  # a mistake in it before one in the folder
    if not is_video(arguments.folder):
        check_folder(arguments.folder)
    check_run_folder(run, [arguments.folder, arguments.head, arguments.tracking])
    if has_plan:
        raise UserError(f"{run} holds a run with --refine: add --resume to go on with it, or choose another --out")
    if arguments.refine is None:
        return train_new(tracked_source(arguments), overrides, run, arguments.device)
    check_rounds(run, arguments.refine, arguments.minutes)
    return begin_rounds(run, arguments.refine, arguments.minutes, tracked_source(arguments), overrides, begin)


def print_config(overrides: list[str]) -> None:
    """The configuration as overrides of itself."""
    for key, value in flatten(load_config(overrides).to_dict()).items():
        text = shown(list(value) if isinstance(value, tuple) else value, MAX_OVERRIDE)
        print(f"{key}={text.replace(', ', ',') if isinstance(value, tuple) else text}")


def dry_run(arguments: Namespace) -> int:
    """What a new run would take, and its configuration."""
    overrides = config_overrides(arguments)
    if is_video(arguments.folder):
        raise UserError(f"{arguments.folder} is a video: give the folder that avatar track writes of it to --dry-run")
    if arguments.minutes is not None:
        raise UserError("--minutes sets the time that --dry-run estimates: leave one of them out")
    if arguments.refine is not None:
        check_plan(arguments.refine, None)
    status = estimate_training(source_of(arguments), overrides, arguments.refine or 0, arguments.device)
    print_config(overrides)
    return status


def assign_paths(arguments: Namespace) -> None:
    """Which of the paths that were typed without an option is the run, and which the tracked folder."""
    runs = [path for path in arguments.paths if (path / RUN_FILE).is_file() or plan_file(path).is_file()]
    if runs and not arguments.resume:
        raise UserError(f"{runs[0]} is a run: add --resume to go on with it, or give the tracked folder of a new one")
    named = [*([] if arguments.out is None else [arguments.out]), *runs]
    if len({path.resolve() for path in named}) > 1:
        raise UserError(f"{named[0]} and {named[1]} are two runs: one at a time is resumed")
    arguments.out = next(iter(named), None)
    folders = [path for path in arguments.paths if path not in runs]
    if len(folders) > 1:
        raise UserError(f"neither {folders[0]} nor {folders[1]} is a run: say which to resume with --out RUN")
    if arguments.folder is not None and any(folder.resolve() != arguments.folder.resolve() for folder in folders):
        raise UserError(f"{folders[0]} and --folder {arguments.folder} are two folders: one at a time is trained on")
    arguments.folder = arguments.folder or next(iter(folders), None)


def check_rounds(run: Path, rounds: int, minutes: float | None) -> None:
    """Before a video is tracked. Raises UserError for a mistake, and where the folder holds a run already."""
    check_plan(rounds, minutes)
    refuse_trained(run)


def check_plan(rounds: int, minutes: float | None) -> None:
    """Raises UserError for numbers out of range."""
    if not 1 <= rounds <= MAX_ROUNDS:
        raise UserError(f"--refine must be from 1 to {MAX_ROUNDS}, not {rounds}")
    if minutes is not None and not 0.0 < minutes < float("inf"):
        raise UserError(f"--minutes must be a positive number, not {minutes:g}")


def refuse_changed_plan(run: Path, plan: Plan, arguments: Namespace, overrides: list[str]) -> None:
    """A resumed run keeps its decisions."""
    for option, was, now in (
        ("--refine", plan.rounds, arguments.refine),
        ("--minutes", plan.minutes, arguments.minutes),
    ):
        if now not in (None, was):
            began = f"without {option}" if was is None else f"with {option} {was:g}"
            raise UserError(f"{run} began {began}, not {now:g}: leave it out to resume")
    began = list(plan.overrides)
    recorded = {**flatten(load_config(began).to_dict()), **chosen_options(began)}
    refuse_changed_keys(run, recorded, overrides, {"device"})
    refuse_other_source(run, plan.source, arguments)


def moved_plan_source(run: Path, source: Source, arguments: Namespace) -> Source:
    """The source, at its new place where the folder or the head model has moved. Raises UserError for another folder."""
    folder, head = arguments.folder, arguments.head
    if folder is not None and folder.resolve() != source.folder and source.folder.is_dir():
        raise UserError(f"{run} began on {source.folder}, not on {folder}: leave it out to resume")
    if folder is None and not source.folder.is_dir():
        raise UserError(
            f"{source.folder}, on which {run} began, is gone: avatar train NEW_PLACE --resume --out {typed(run)}"
        )
    source = source if folder is None else at_new_place(source, folder.resolve())
    return source if head is None else replace(source, head=head)


def tracked_source(arguments: Namespace) -> Source:
    """What to train on; a video is tracked first."""
    if is_video(arguments.folder):
        head = head_for_video(arguments.folder, arguments.head)
        arguments.head, arguments.folder = head, cached_tracking(arguments.folder, head)
    return source_of(arguments)


def drop_video(arguments: Namespace) -> None:
    """A run that is resumed knows where the tracking of its video is."""
    if arguments.folder is not None and is_video(arguments.folder):
        arguments.folder = None


def asked_device(overrides: list[str]) -> str | None:
    """What the command line says of `device`, the one key of a configuration that a run may change."""
    own = [override for override in overrides if override.partition("=")[0] == "device"]
    return load_config(own).device if own else None


def default_run(folder: Path | None) -> Path:
    if folder is None:
        raise UserError("say which run to go on with: avatar train --resume RUN")
    folder = folder.resolve()
    return Path("runs") / safe_name(folder.stem if folder.is_file() else display_name(folder))


def config_overrides(arguments: Namespace) -> list[str]:
    """The options that are short forms of configuration keys, before the overrides, so that those win. Raises UserError
    for an option's value that its key does not take."""
    short = {key: value for key in SHORT_FORMS if (value := getattr(arguments, key.rpartition(".")[2])) is not None}
    for key, value in short.items():
        check_value(key, value, f"--{key.rpartition('.')[2]}")
    groups = [o for o in arguments.overrides if "." not in o.partition("=")[0]]
    keys = [o for o in arguments.overrides if o not in groups]
    return [*groups, *(f"{key}={value}" for key, value in short.items()), *keys]


def refuse_changed_run(run: Path, info: RunInfo, arguments: Namespace, overrides: list[str]) -> None:
    """A resumed run keeps its decisions; naming another value for one is an error, not a silent choice."""
    recorded = {**flatten(info.config.to_dict()), **info.options}
    asked = load_config(overrides).trainer
    limited = (
        recorded["trainer.max_epochs"] is not None
        and asked.max_epochs == recorded["trainer.max_epochs"]
        and asked.iterations > recorded["trainer.iterations"]
    )
    free = {"device", *(["trainer.iterations"] if limited else [])}  # what was asked for is not recorded
    refuse_changed_keys(run, recorded, overrides, free)
    refuse_other_source(run, info.source, arguments)


def refuse_changed_keys(run: Path, recorded: Mapping[str, Any], overrides: list[str], free: Collection[str]) -> None:
    """Raises UserError for an override of another value than the recorded one, of keys that are not `free`."""
    asked = {**flatten(load_config(overrides).to_dict()), **chosen_options(overrides)}
    for key in (override.partition("=")[0] for override in overrides):
        if key not in free and recorded[key] != asked[key]:
            raise UserError(
                f"{run} began with {key}={recorded[key]}, not {asked[key]}: leave the override out to resume, or "
                "start a new run"
            )


def refuse_other_source(run: Path, source: Source, arguments: Namespace) -> None:
    """Of the options that say how the folder is read, none may change."""
    for field in ("tracking", "frame_offset", "data_format", "fps", "max_left_out", "ignore_misfit", "cameras"):
        was, now, option = getattr(source, field), getattr(arguments, field), f"--{field.replace('_', '-')}"
        now = now.resolve() if isinstance(now, Path) else now
        if now is None or now is False or now == "" or now == was:
            continue
        began = f"without {option}" if was is None or was is False else f"with {option} {was}"
        given_now = option if now is True else f"{option} {now}"
        raise UserError(f"{run} began {began}, not with {given_now}: leave it out to resume, or start a new run")
