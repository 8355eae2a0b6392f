"""The optimizer: Adam with one learning rate per group of parameters, and its state as named tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from avatar.compute.device import on_gpu
from avatar.compute.gpu_functions import gpu_function
from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.train.pose_corrections import PoseCorrections

EPSILON = 1e-15  # Adam's
WARM_UP = 20  # steps
FINAL_SHARE = 0.05  # of the learning rates, at the last step


def make_optimizer(
    avatar: Avatar, config: TrainerConfig, pose_corrections: PoseCorrections | None = None
) -> torch.optim.Adam:
    """Adam with the model's groups of parameters, and that of the pose corrections."""
    named = list(avatar.parameter_groups(config).values())
    if pose_corrections is not None:
        named.append(([pose_corrections.moves], config.pose_rate))
    groups: list[dict[str, Any]] = [{"params": params, "lr": rate, "full_lr": rate} for params, rate in named]
    if on_gpu(avatar.quats):
        return gpu_function("Adam")(groups, eps=EPSILON, device=avatar.device)
    return torch.optim.Adam(groups, eps=EPSILON, fused=True)


def schedule(step: int, config: TrainerConfig) -> float:
    """The share of the learning rates that step `step` (from 0) uses.

    1 without `lr_decay`. With it, rises linearly to 1 over the first steps, times half a cosine from 1 at the first step to
    `FINAL_SHARE` at the last. A pure function of the step, so that a resumed run goes on as an uninterrupted one.
    """
    if not config.lr_decay:
        return 1.0
    rise = min((step + 1) / WARM_UP, 1.0)
    fall = 0.5 * (1.0 + math.cos(math.pi * step / max(config.iterations - 1, 1)))
    return rise * (FINAL_SHARE + (1.0 - FINAL_SHARE) * fall)


def set_rates(optimizer: torch.optim.Adam, share: float) -> None:
    """Give every group this share of the learning rate that it was made with."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):  # of a GPU's, one for all groups: the share
            group["lr"].fill_(share)
            return
        group["lr"] = group["full_lr"] * share


def optimizer_tensors(optimizer: torch.optim.Adam, named: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """Adam's state under names made of the parameter's: optimizer.<parameter>.<exp_avg | exp_avg_sq | step>."""
    return {
        f"optimizer.{name}.{key}": value
        for name, parameter in named.items()
        for key, value in optimizer.state[parameter].items()
    }


def load_optimizer(
    optimizer: torch.optim.Adam, named: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor]
) -> None:
    """Put back what `optimizer_tensors` gave, to the bit."""
    for name, parameter in named.items():
        prefix = f"optimizer.{name}."
        own = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
        if own.keys() != {"exp_avg", "exp_avg_sq", "step"}:
            raise UserError(f"the checkpoint lacks the optimizer state of {name}; training cannot go on from it")
        state = optimizer.state[parameter]
        for key, value in own.items():
            if key in state:  # where a GPU's kernels read it
                state[key].copy_(value)
            elif value.shape == parameter.shape:  # in the parameter's order in memory, which a fused step relies on
                state[key] = torch.empty_like(parameter).copy_(value)
            else:
                state[key] = value.to(parameter.device, copy=True)
