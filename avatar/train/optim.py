"""The optimizer: Adam with one learning rate per group of parameters, and its state as named tensors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.model import Avatar


def make_optimizer(avatar: Avatar, config: TrainerConfig) -> torch.optim.Adam:
    """Adam with the paper's groups: colour, opacity, scale, rotation, deformation network, HyperGaussian heads."""
    rates = config.learning_rates
    groups = [
        {"params": [avatar.sh_dc], "lr": rates.sh_dc},
        {"params": [avatar.sh_rest], "lr": rates.sh_rest},
        {"params": [avatar.opacity_logits], "lr": rates.opacity},
        {"params": [avatar.log_scales], "lr": rates.scale},
        {"params": [avatar.quats], "lr": rates.rotation},
        {"params": list(avatar.deformation.parameters()), "lr": rates.mlp},
    ]
    if avatar.hyper is not None:
        groups.append({"params": list(avatar.hyper.parameters()), "lr": rates.hyper})
    return torch.optim.Adam(groups, eps=config.adam_eps, fused=True)


def optimizer_tensors(optimizer: torch.optim.Adam, avatar: Avatar) -> dict[str, Tensor]:
    """Adam's state under names made of the parameter's: optimizer.<parameter>.<exp_avg | exp_avg_sq | step>."""
    return {
        f"optimizer.{name}.{key}": value
        for name, parameter in avatar.named_parameters()
        for key, value in optimizer.state[parameter].items()
    }


def load_optimizer(optimizer: torch.optim.Adam, avatar: Avatar, tensors: Mapping[str, Tensor]) -> None:
    """Put back what `optimizer_tensors` gave, to the bit."""
    for name, parameter in avatar.named_parameters():
        prefix = f"optimizer.{name}."
        state = {key.removeprefix(prefix): value.clone() for key, value in tensors.items() if key.startswith(prefix)}
        if state.keys() != {"exp_avg", "exp_avg_sq", "step"}:
            raise UserError(f"the checkpoint lacks the optimizer state of {name}; training cannot go on from it")
        optimizer.state[parameter] = state
