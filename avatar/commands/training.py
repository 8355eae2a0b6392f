"""avatar train: a tracked folder in, a run out; and going on with one."""

from __future__ import annotations

import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import torch

from avatar.commands import INTERRUPTED, OK
from avatar.commands.opening import check_data, moved_source, source_of, split_sizes
from avatar.commands.outputs import check_run_folder
from avatar.commands.tracking import head_for_video, is_video, tracked_once
from avatar.compute.choose import choose_device
from avatar.compute.device import CPU, free_bytes
from avatar.compute.memory import check_memory
from avatar.config import Config, chosen_options, flatten, load_config
from avatar.data.source import Source
from avatar.data.split import check_divided
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.files.names import safe_name
from avatar.head.assets import HeadAssets
from avatar.model import Avatar
from avatar.runs.avatar_file import check_head
from avatar.runs.checkpoint import Checkpoint, newest_checkpoint
from avatar.runs.footprint import training_needs
from avatar.runs.run import RunInfo, read_run_info, refuse_trained, start_run
from avatar.train.order import within_passes
from avatar.train.step import PerceptualTerm, choose_perceptual
from avatar.train.trainer import leave_avatar, train
from data_prep.not_subjects import check_folder
from data_prep.open import open_subject

# Adam's epsilon makes whole steps of gradients that are nothing but rounding.
OTHER_ROUNDING = "pictures come out alike, not to the bit, and parameters that they hardly depend on may differ"


def run_train(arguments: Namespace) -> int:
    run = arguments.out or default_run(arguments.folder)
    overrides = config_overrides(arguments)
    if arguments.resume:
        forget_video(arguments)
        refuse_changes(run, read_run_info(run), arguments, overrides)
        return resume_run(run, arguments.head, arguments.folder, arguments.device or asked_device(overrides))
    load_config(overrides)  # a mistake in it before one in the folder
    if not is_video(arguments.folder):
        check_folder(arguments.folder)
    check_run_folder(run, [arguments.folder, arguments.head, arguments.tracking])
    return train_new(tracked_source(arguments), overrides, run, arguments.device)


def tracked_source(arguments: Namespace) -> Source:
    """What to train on; a video is tracked first."""
    if is_video(arguments.folder):
        head = head_for_video(arguments.folder, arguments.head)
        arguments.head, arguments.folder = head, tracked_once(arguments.folder, head)
    return source_of(arguments)


def forget_video(arguments: Namespace) -> None:
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
    return Path("runs") / safe_name(folder.resolve().stem if folder.is_file() else folder.resolve().name)


def train_new(source: Source, overrides: list[str], run: Path, device: str | None = None) -> int:
    """`device` stands in for the configuration's."""
    config = load_config(overrides)
    with locked(run):
        refuse_trained(run)
        chosen = choose_device(device or config.device, print)
        subject, assets = open_subject(source, split_sizes(config))
        check_divided(subject.split)
        config = on_subject(config, subject)
        size = subject.image_size(config.data.size)
        perceptual = choose_perceptual(config.trainer, print, size=size, device=chosen)
        avatar = new_avatar(assets, subject, config, perceptual.name, chosen)
        start_run(run, source, config, subject, perceptual.name, chosen_options(overrides))
        return finish_training(avatar, subject, config, run, perceptual, chosen)


def on_subject(config: Config, subject: Subject) -> Config:
    """With the steps that `trainer.passes` leaves on this subject; says so where they are fewer."""
    trainer = within_passes(config.trainer, len(subject.split.train))
    if trainer.iterations < config.trainer.iterations:
        print(f"{trainer.passes} passes over the training frames are {trainer.iterations:,} steps (trainer.passes)")
    return replace(config, trainer=trainer)


def resume_run(run: Path, head: Path | None = None, folder: Path | None = None, device: str | None = None) -> int:
    """Go on from the newest checkpoint, with the decisions that the run began with."""
    with locked(run):
        info, checkpoint = read_run_info(run), newest_checkpoint(run)
        source = moved_source(run, info, head, folder)
        subject, assets = open_subject(source, split_sizes(info.config))
        check_head(info.head_fingerprint, assets, run)
        check_data(run, info, subject)
        return go_on(run, info, checkpoint, subject, assets, device)


def go_on(
    run: Path, info: RunInfo, checkpoint: Checkpoint, subject: Subject, assets: HeadAssets, device: str | None
) -> int:
    config = info.config
    if checkpoint.meta.get("threads") != torch.get_num_threads():
        print(
            f"Note: the checkpoint was made with {checkpoint.meta.get('threads')} threads, this machine uses "
            f"{torch.get_num_threads()}; {OTHER_ROUNDING}"
        )
    is_complete = checkpoint.step >= config.trainer.iterations
    chosen = CPU if is_complete else choose_device(device or config.device, print)
    avatar = new_avatar(assets, subject, config, info.perceptual, chosen)
    if is_complete:
        leave_avatar(run, avatar, checkpoint, subject, config, info.perceptual)
        print(f"{run} is complete ({checkpoint.step} steps). Next: avatar eval {run}")
        return OK
    if (before := checkpoint.meta.get("device", "cpu")) != chosen.type:
        print(f"Note: the checkpoint was made on {before}, this is {chosen.type}; {OTHER_ROUNDING}")
    size = subject.image_size(config.data.size)
    perceptual = choose_perceptual(config.trainer, print, recorded=info.perceptual, size=size, device=chosen)
    print(f"Resuming {run} at step {checkpoint.step} of {config.trainer.iterations}")
    return finish_training(avatar, subject, config, run, perceptual, chosen, checkpoint)


def new_avatar(assets: HeadAssets, subject: Subject, config: Config, perceptual: str, device: torch.device) -> Avatar:
    """An avatar with its initial parameters. Raises UserError, before any is made, when training it needs more memory than
    there is."""
    size = subject.image_size(config.data.size)
    frames = len(subject.split.train)
    needs = training_needs(config, assets, frames=frames, size=size, perceptual=perceptual)
    check_memory("training", needs, free_bytes(device))
    torch.manual_seed(config.trainer.seed)
    return Avatar(assets, subject.identity, config.model)


def finish_training(
    avatar: Avatar,
    subject: Subject,
    config: Config,
    run: Path,
    perceptual: PerceptualTerm,
    device: torch.device,
    checkpoint: Checkpoint | None = None,
) -> int:
    split = subject.split
    print(
        f"Training {len(avatar):,} Gaussians ({config.model.name}) on {len(split.train)} frames of {subject.name}, "
        f"{len(split.test)} held out, {config.trainer.iterations:,} steps"
    )
    begin = time.monotonic()
    done = train(avatar, subject, config, run, perceptual, resume=checkpoint, device=device)
    first = checkpoint.step if checkpoint else 0
    seconds = time.monotonic() - begin
    rate = f"{seconds / max(done - first, 1):.3f} s per step"
    if done < config.trainer.iterations:
        print(f"\nInterrupted at step {done} ({rate}); everything up to there is saved in {run}.")
        print("Add --resume to the same command to go on.")
        return INTERRUPTED
    print(f"Trained in {seconds:.0f} s ({rate}).")
    print(f"Avatar       {run / 'avatar.safetensors'}")
    print(f"Previews     {run / 'previews'}")
    if next((curves := run / "tensorboard").glob("events*"), None) is not None:
        print(f"Curves       tensorboard --logdir {curves}")
    print(f"Next         avatar eval {run}")
    return OK


def config_overrides(arguments: Namespace) -> list[str]:
    """The options that are short forms of configuration keys, before the overrides, so that those win."""
    short = {"data.size": arguments.size, "trainer.iterations": arguments.iterations, "trainer.seed": arguments.seed}
    groups = [o for o in arguments.overrides if "." not in o.partition("=")[0]]
    keys = [o for o in arguments.overrides if o not in groups]
    return [*groups, *(f"{key}={value}" for key, value in short.items() if value is not None), *keys]


def refuse_changes(run: Path, info: RunInfo, arguments: Namespace, overrides: list[str]) -> None:
    """A resumed run keeps its decisions; naming another value for one is an error, not a silent choice."""
    if overrides:
        recorded = {**flatten(info.config.to_dict()), **info.options}
        asked = {**flatten(load_config(overrides).to_dict()), **chosen_options(overrides)}
        limited = (
            recorded["trainer.passes"] is not None
            and asked["trainer.passes"] == recorded["trainer.passes"]
            and asked["trainer.iterations"] > recorded["trainer.iterations"]
        )
        free = {"device", *(["trainer.iterations"] if limited else [])}  # what was asked for is not recorded
        for key in (override.partition("=")[0] for override in overrides):
            if key not in free and recorded[key] != asked[key]:
                raise UserError(
                    f"{run} began with {key}={recorded[key]}, not {asked[key]}: leave the override out to resume, or "
                    "start a new run"
                )
    refuse_other_source(run, info.source, arguments)


def refuse_other_source(run: Path, source: Source, arguments: Namespace) -> None:
    """Of the options that say how the folder is read, none may change."""
    given = replace(
        source,
        tracking=source.tracking if arguments.tracking is None else arguments.tracking.resolve(),
        frame_offset=source.frame_offset if arguments.frame_offset is None else arguments.frame_offset,
        format=arguments.format or source.format,
        fps=source.fps if arguments.fps is None else arguments.fps,
        max_left_out=source.max_left_out if arguments.max_left_out is None else arguments.max_left_out,
        ignore_misfit=source.ignore_misfit or arguments.ignore_misfit,
    )
    for field, option in (
        ("tracking", "--tracking"),
        ("frame_offset", "--frame-offset"),
        ("format", "--format"),
        ("fps", "--fps"),
        ("max_left_out", "--max-left-out"),
        ("ignore_misfit", "--ignore-misfit"),
    ):
        was, now = getattr(source, field), getattr(given, field)
        if was != now:
            began = f"without {option}" if was in (None, False) else f"with {option} {was}"
            given_now = option if now is True else f"{option} {now}"
            raise UserError(f"{run} began {began}, not with {given_now}: leave it out to resume, or start a new run")
