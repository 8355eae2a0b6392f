"""A small trained avatar whose parameters are all in use: what training moves in minutes is drawn from a generator."""

from __future__ import annotations

from pathlib import Path

import torch
from small_runs import train_small

from avatar.runs.trained_avatar import TrainedAvatar, load_avatar


def lively_run(folder: Path, run: Path, *overrides: str) -> Path:
    """A finished run of the tracked folder `folder` under `run`."""
    train_small(folder, run, ["trainer.iterations=4", "model.uv_size=40", *overrides])
    return run


def lively_avatar(folder: Path, run: Path, *overrides: str, seed: int = 3) -> TrainedAvatar:
    """Colours, opacities, sizes, turns and offsets of every Gaussian differ, and the offsets from frame to frame."""
    return enlivened(load_avatar(lively_run(folder, run, *overrides), folder / "head_model"), seed)


def enlivened(trained: TrainedAvatar, seed: int = 3) -> TrainedAvatar:
    """`trained`, changed in place."""
    generator = torch.Generator().manual_seed(seed)
    spread = {
        "quats": 0.3,
        "log_scales": 0.2,
        "opacity_logits": 1.5,
        "sh_dc": 0.8,
        "sh_rest": 0.05,
        "deformation": 0.02,
        "hyper": 0.02,
        "mesh_points": 0.002,
        "skull_logits": 2.0,
        "positions": 0.002,
        "features": 0.1,
        "networks": 0.02,
        "upsampler": 0.02,
    }
    with torch.no_grad():
        for name, parameter in trained.avatar.named_parameters():
            deviation = spread[name.split(".")[0]]
            parameter += deviation * torch.randn(parameter.shape, generator=generator)
    return trained


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Of values in [0, 1]."""
    return float(-10 * torch.log10((a.double() - b.double()).square().mean().clamp(min=1e-12)))
