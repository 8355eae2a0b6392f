"""A tiny run, configured in one place: a few dozen frames, a few hundred Gaussians, steps that take milliseconds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from avatar.checkpoint import Checkpoint
from avatar.config import Config, load_config
from avatar.data.subject import Subject
from avatar.head.assets import HeadAssets
from avatar.model import Avatar
from avatar.run import Source, open_subject, start_run
from avatar.train.trainer import train

SMALL = (
    "model.uv_size=20",
    "model.mlp_width=24",
    "model.mlp_layers=2",
    "trainer.iterations=12",
    "trainer.sh_interval=3",
    "trainer.checkpoint_every=4",
    "trainer.preview_every=6",
    "trainer.log_every=2",
)


def small_config(*overrides: str) -> Config:
    return load_config([*SMALL, *overrides])


def open_small(folder: Path, config: Config) -> tuple[Source, Subject, HeadAssets]:
    source = Source(folder, folder / "head_model", frame_offset=1)
    subject, assets = open_subject(source, config, lambda _: None)
    return source, subject, assets


def new_avatar(assets: HeadAssets, subject: Subject, config: Config) -> Avatar:
    torch.manual_seed(config.trainer.seed)
    return Avatar(assets, subject.identity, config.model)


def train_small(
    folder: Path, run: Path, overrides: Sequence[str] = (), resume: Checkpoint | None = None
) -> tuple[Avatar, int]:
    """Train into `run`, from the start or from a checkpoint; returns the avatar and the number of steps done."""
    config = small_config(*overrides)
    source, subject, assets = open_small(folder, config)
    avatar = new_avatar(assets, subject, config)
    if resume is None:
        start_run(run, source, config, subject)
    return avatar, train(avatar, subject, config, run, resume=resume, say=lambda _: None)
