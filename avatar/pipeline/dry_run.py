"""`avatar train --dry-run`: what a training would take here, of time, memory and disk."""

from __future__ import annotations

import torch

from avatar.compute.device import CPU, free_bytes
from avatar.compute.memory import available_bytes, check_memory, in_words
from avatar.config import load_config
from avatar.data.source import Source
from avatar.data.split import check_divided
from avatar.pipeline import OK
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.refine_plan import round_steps
from avatar.pipeline.train import config_for_subject, new_avatar
from avatar.pose_refinement.refine_subject import estimated_seconds
from avatar.runs.checkpoint import KEPT
from avatar.runs.memory_estimate import training_needs
from avatar.runs.model_registry import refuse_features
from avatar.train.cost_estimate import measure_cost
from avatar.train.loss import choose_perceptual
from data_prep.prepare.open_subject import open_subject

DISK_COPIES = 1 + 3 * (KEPT + 1)  # of the parameters: the avatar; the checkpoints, with one more while it is written


def estimate_training(source: Source, overrides: list[str], rounds: int, device: str | None) -> int:
    """Print it. A few steps are made on one frame, and thrown away. The subject stays prepared in the cache.

    Raises UserError as training does, before its first step.
    """
    config = load_config(overrides)
    chosen = choose_device(device or config.device, print)
    subject, assets = open_subject(source, config.data.test_frames, test_cameras=config.data.test_cameras)
    if rounds:
        refuse_features(config.model, "--refine")
    check_divided(subject.split)
    config, size = config_for_subject(config, subject), subject.image_size(config.data.size)
    frames = len(subject.split.train)
    smallest = subject.recording.smallest_size(config.data.size)
    perceptual = choose_perceptual(config.trainer, print, size=smallest, device=chosen)
    needs = training_needs(config, assets, frames=frames, size=size, perceptual=perceptual.name)
    available = free_bytes(chosen) or available_bytes()  # before the steps, whose memory stays
    check_memory("training", needs, available)
    frame = subject.frame(subject.split.train[0], config.data.size)
    cost = measure_cost(frame, subject, assets, config)
    seconds = cost.start_seconds * (1 + rounds)
    seconds += cost.step_seconds * (cost.iterations + rounds * round_steps(cost.iterations, frames))
    if rounds:
        avatar = new_avatar(assets, subject, config, perceptual.name, CPU)
        background = torch.tensor(config.data.background)
        seconds += rounds * estimated_seconds(avatar, subject, config.data.size, background)
    estimate = f"about {as_duration(seconds)}: " if chosen.type == "cpu" else "not estimated on a GPU: "
    step = f" of {cost.step_seconds:.3f} s, measured on a few" if chosen.type == "cpu" else ""
    print(f"Subject      {subject.name}: {frames:,} frames to train on, {len(subject.split.test):,} held out")
    print(f"Avatar       {cost.gaussians:,} Gaussians ({config.model.name}), {size[0]}x{size[1]} pixels")
    print(f"Time         {estimate}{cost.iterations:,} steps{step}")
    print(f"Memory       about {in_words(sum(need.size for need in needs))} of {in_words(available)}")
    print(f"Disk         about {in_words(4.0 * DISK_COPIES * cost.parameters * (1 + rounds))}")
    return OK


def as_duration(seconds: float) -> str:
    """In minutes; from two hours on in hours, from two days on in days."""
    hours = seconds / 3600
    return (
        f"{60 * hours:.1f} minutes" if hours < 2 else f"{hours:.1f} hours" if hours < 48 else f"{hours / 24:,.0f} days"
    )
