"""A tiny run, configured in one place: a few dozen frames, a few hundred Gaussians, steps that take milliseconds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from avatar.config import Config, chosen_options, load_config
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.runs.checkpoint import Checkpoint
from avatar.runs.model_registry import make_avatar
from avatar.runs.run import start_run
from avatar.train.loss import choose_perceptual
from avatar.train.trainer import train
from data_prep.prepare.open_subject import open_subject

SMALL = (
    "model.uv_size=20",
    "model.mlp_width=24",
    "model.mlp_layers=2",
    "trainer.iterations=12",
    "trainer.checkpoint_every=4",
)
QUICK = (*SMALL, "trainer.iterations=16")


def small_config(*overrides: str) -> Config:
    return load_config([*SMALL, *overrides])


def open_small(folder: Path, config: Config) -> tuple[Source, Subject, HeadAssets]:
    source = Source(folder, folder / "head_model", frame_offset=1)
    subject, assets = open_subject(source, config.data.test_frames, lambda _: None)
    return source, subject, assets


def new_avatar(assets: HeadAssets, subject: Subject, config: Config) -> Avatar:
    torch.manual_seed(config.trainer.seed)
    return make_avatar(assets, subject.identity, config.model)


def train_small(
    folder: Path, run: Path, overrides: Sequence[str] = (), resume: Checkpoint | None = None
) -> tuple[Avatar, int]:
    """Train into `run`, from the start or from a checkpoint; returns the avatar and the number of steps done."""
    config = small_config(*overrides)
    source, subject, assets = open_small(folder, config)
    avatar = new_avatar(assets, subject, config)
    perceptual = choose_perceptual(config.trainer, lambda _: None)
    if resume is None:
        start_run(run, source, config, subject, perceptual.name, chosen_options(overrides))
    return avatar, train(avatar, subject, config, run, perceptual, resume=resume)


def run_info(perceptual: str) -> dict[str, Any]:
    """What run.json holds, of a run that was never made."""
    return {
        "name": "someone",
        "source": Source(Path("/x"), Path("/y")).to_dict(),
        "data_hash": "0" * 64,
        "head_fingerprint": "1" * 64,
        "config": small_config().to_dict(),
        "options": chosen_options(SMALL),
        "perceptual": perceptual,
        "versions": {},
    }
