"""What training on this folder will take, measured on a few steps of the real thing."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.config import Config
from avatar.data.loader import BYTES_PER_PIXEL
from avatar.head.assets import HeadAssets
from avatar.model import Avatar
from avatar.train.optim import make_optimizer
from avatar.train.step import Objective, choose_perceptual, training_step
from avatar.types import Frame

MEASURED_STEPS = 3  # after one that is not counted
_COPIES = 4  # of every parameter: itself, its gradient, Adam's two moments


@dataclass(frozen=True)
class Cost:
    gaussians: int
    parameters: int
    step_seconds: float  # median, on this machine, with all terms of the loss
    iterations: int
    cache_bytes: int  # decoded frames, at most what the configuration allows
    parameter_bytes: int  # with gradients and the optimizer's state

    def facts(self) -> dict[str, str]:
        hours, minutes = divmod(round(self.step_seconds * self.iterations / 60), 60)
        return {
            "Gaussians": f"{self.gaussians:,}",
            "one training step on this machine": f"{self.step_seconds:.3f} s ({torch.get_num_threads()} threads)",
            f"the recipe's {self.iterations:,} steps": f"{hours} h {minutes} min" if hours else f"{minutes} min",
            "memory for decoded frames": f"{self.cache_bytes / 2**20:,.0f} MiB",
            "memory for parameters and optimizer": f"{self.parameter_bytes / 2**20:,.0f} MiB",
        }


def measure_cost(frame: Frame, assets: HeadAssets, identity: Float[Tensor, " S"], frames: int, config: Config) -> Cost:
    """Train an avatar of this head on one of its frames for a few steps, and throw it away; the video has `frames`.

    Raises UserError for frames that are too small to train on.
    """
    torch.manual_seed(config.trainer.seed)
    avatar = Avatar(assets, identity, config.model)
    optimizer = make_optimizer(avatar, config.trainer)
    size = frame.camera.width, frame.camera.height
    term = choose_perceptual(config.trainer, lambda _: None, size=size)
    objective = Objective(config.trainer, torch.tensor(config.data.background), term)
    vertices = avatar.head.vertices(frame.params)
    seconds = []
    last = config.trainer.iterations - 1  # when all of the loss and of the colour takes part
    for _ in range(1 + MEASURED_STEPS):
        begin = time.perf_counter()
        training_step(avatar, optimizer, objective, last, frame, vertices)
        seconds.append(time.perf_counter() - begin)
    height, width = frame.image.shape[:2]
    parameters = sum(p.numel() for p in avatar.parameters())
    return Cost(
        gaussians=len(avatar),
        parameters=parameters,
        step_seconds=float(np.median(seconds[1:])),
        iterations=config.trainer.iterations,
        cache_bytes=min(width * height * BYTES_PER_PIXEL * frames, config.data.cache_mb << 20),
        parameter_bytes=4 * _COPIES * parameters,
    )
