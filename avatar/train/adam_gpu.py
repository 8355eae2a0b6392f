"""Adam on a GPU, a launch for each parameter.

torch's fused kernel takes a block for every 65,536 values, so that the parameters of 20,000 Gaussians keep a third of an
H200 busy; these fill it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from avatar.kernels.adam import adam
from avatar.kernels.launch import start

LANES = 1024  # values of a program


class GpuAdam(torch.optim.Adam):
    """`torch.optim.Adam` for float32 parameters on one GPU, at a share of each group's rate `full_lr`.

    The share is a tensor there, every group's `lr`. All parameters have taken the same number of steps. A step does nothing
    where `found_inf` is not zero.
    """

    found_inf: Tensor

    def __init__(self, groups: Iterable[Mapping[str, Any]], *, eps: float, device: torch.device) -> None:
        super().__init__([dict(group) for group in groups], eps=eps)
        self.found_inf = torch.zeros((), device=device)
        share = torch.ones((), device=device)
        for group in self.param_groups:
            group["lr"] = share
        parameters = [p for group in self.param_groups for p in group["params"]]
        self._steps = torch.zeros(len(parameters), device=device)
        for parameter, steps in zip(parameters, self._steps, strict=True):
            means = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
            self.state[parameter] = {"step": steps, **means}

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move every parameter by its gradient."""
        self._steps.add_(1.0 - self.found_inf)
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                start(
                    adam,
                    -(-parameter.numel() // LANES),
                    parameter,
                    in_order_of(parameter, parameter.grad),
                    state["exp_avg"],
                    state["exp_avg_sq"],
                    group["full_lr"],
                    group["lr"],
                    state["step"],
                    self.found_inf,
                    parameter.numel(),
                    warps=4,
                    BETA1=beta1,
                    BETA2=beta2,
                    EPSILON=group["eps"],
                    LOG2_BETA1=math.log2(beta1),
                    LOG2_BETA2=math.log2(beta2),
                    BLOCK=LANES,
                )


def in_order_of(parameter: Tensor, gradient: Tensor) -> Tensor:
    """The gradient in the parameter's order in memory, by which the kernel pairs their values."""
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)
