"""Training: a source in, a run out; and resuming one."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import torch

from avatar.compute.device import CPU, free_bytes
from avatar.compute.memory import check_memory
from avatar.config import Config, chosen_options, load_config
from avatar.data.loader import BYTES_PER_PIXEL, CACHE_BYTES
from avatar.data.source import Source
from avatar.data.split import check_divided
from avatar.data.subject import Subject
from avatar.files.lock import locked
from avatar.files.names import typed
from avatar.files.read import shown_size
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.pipeline import INTERRUPTED, OK
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.open_inputs import check_data, check_division, moved_source
from avatar.runs.avatar_file import check_head
from avatar.runs.checkpoint import Checkpoint, newest_checkpoint, newest_step
from avatar.runs.memory_estimate import training_needs
from avatar.runs.model_registry import keys_without_effect, make_avatar
from avatar.runs.run import RunInfo, read_run_info, refuse_trained, start_run
from avatar.runs.training_curves import CURVES_FILE
from avatar.train.frame_order import within_epochs
from avatar.train.loss import PerceptualTerm, choose_perceptual
from avatar.train.trainer import save_avatar, train
from data_prep.prepare.open_subject import open_subject

# Adam's epsilon makes whole steps of gradients that are nothing but rounding.
OTHER_ROUNDING = "pictures come out alike, not to the bit, and parameters that they hardly depend on may differ"


def train_new(source: Source, overrides: list[str], run: Path, device: str | None = None) -> int:
    """`device` stands in for the configuration's."""
    config = load_config(overrides)
    for key in keys_without_effect(overrides, config.model.name):
        print(f"Note: {key} has no effect on model={config.model.name}")
    with locked(run):
        refuse_trained(run)
        chosen = choose_device(device or config.device, print)
        subject, assets = open_subject(source, config.data.test_frames, test_cameras=config.data.test_cameras)
        check_divided(subject.split)
        config = config_for_subject(config, subject)
        size = subject.recording.smallest_size(config.data.size)
        perceptual = choose_perceptual(config.trainer, print, size=size, device=chosen)
        avatar = new_avatar(assets, subject, config, perceptual.name, chosen)
        start_run(run, source, config, subject, perceptual.name, chosen_options(overrides))
        return finish_training(avatar, subject, config, run, perceptual, chosen)


def config_for_subject(config: Config, subject: Subject) -> Config:
    """With the steps that `trainer.max_epochs` leaves on this subject; says so where they are fewer."""
    trainer = within_epochs(config.trainer, len(subject.split.train))
    if trainer.iterations < config.trainer.iterations:
        print(f"{trainer.max_epochs} epochs are {trainer.iterations:,} steps (trainer.max_epochs)")
    return replace(config, trainer=trainer)


def resume_run(run: Path, head: Path | None = None, folder: Path | None = None, device: str | None = None) -> int:
    """Go on from the newest checkpoint, with the decisions that the run began with."""
    with locked(run):
        info, checkpoint = read_run_info(run), newest_checkpoint(run)
        source = moved_source(run, info, head, folder)
        held_out = info.config.data
        subject, assets = open_subject(source, held_out.test_frames, test_cameras=held_out.test_cameras)
        check_head(info.head_fingerprint, assets, run)
        check_data(run, info, subject)
        check_division(run, checkpoint.meta["split"], subject)
        return continue_training(run, info, checkpoint, subject, assets, device)


def continue_training(
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
        save_avatar(run, avatar, checkpoint, subject, config, info.perceptual)
        print(f"{run} is complete ({checkpoint.step} steps).")
        return OK
    if (before := checkpoint.meta.get("device", "cpu")) != chosen.type:
        print(f"Note: the checkpoint was made on {before}, this is {chosen.type}; {OTHER_ROUNDING}")
    size = subject.recording.smallest_size(config.data.size)
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
    return make_avatar(assets, subject.identity, config.model)


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
    rig = subject.recording.rig
    by = "" if rig is None else f" by {len({rig.views[i] for i in split.train})} cameras"
    print(
        f"Training {len(avatar):,} Gaussians ({config.model.name}) on {len(split.train)} frames of {subject.name}{by}, "
        f"{len(split.test)} held out, {config.trainer.iterations:,} steps"
    )
    width, height = subject.image_size(config.data.size)
    decoded = len(split.train) * width * height * BYTES_PER_PIXEL
    if device.type == "cpu" and decoded > CACHE_BYTES:
        print(
            f"Note: the decoded frames take {shown_size(decoded)}, of which {shown_size(CACHE_BYTES)} are kept in memory; "
            "the others are decoded again at each turn"
        )
    if config.trainer.checkpoint_every < config.trainer.iterations:
        print(f"Watch        avatar view {typed(run)} (from step {config.trainer.checkpoint_every} on)")
    begin = time.monotonic()
    try:
        done = train(avatar, subject, config, run, perceptual, resume=checkpoint, device=device)
    except KeyboardInterrupt:
        if (saved := newest_step(run)) is None:
            raise
        print(f"\nInterrupted at once; the last checkpoint in {run} is of step {saved}.")
        return INTERRUPTED
    first = checkpoint.step if checkpoint else 0
    seconds = time.monotonic() - begin
    rate = f"{seconds / max(done - first, 1):.3f} s per step"
    if done < config.trainer.iterations:
        print(f"\nInterrupted at step {done} ({rate}); everything up to there is saved in {run}.")
        return INTERRUPTED
    print(f"Trained in {seconds:.0f} s ({rate}).")
    print(f"Avatar       {run / 'avatar.safetensors'}")
    print(f"Previews     {run / 'previews'}")
    print(f"Curves       {run / CURVES_FILE}")
    return OK
