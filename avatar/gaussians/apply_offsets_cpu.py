"""Offsets applied to the Gaussians on the CPU by the compiled kernel, as an autograd function."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.compute.native import instruction_set, thread_count
from avatar.types import Gaussians

_ACTIVATED = Gaussians._fields[:4]  # all but sh


def apply_offsets_cpu(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    raw: Float[Tensor, "N 10"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, quats, scales and opacities of `apply_offsets` for float32 tensors on the CPU.

    No Gaussian's result depends on another's: the bits are the same for any number of threads.
    """
    return _ApplyOffsets.apply(points, quats, log_scales, opacity_logits, raw)  # pyright: ignore


class _Gradients(NamedTuple):
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    raw: Tensor


class _ApplyOffsets(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *parameters: Tensor) -> tuple[Tensor, ...]:
        points, quats, log_scales, opacity_logits, raw = (tensor.detach().contiguous() for tensor in parameters)
        activated = tuple(torch.empty_like(tensor) for tensor in (points, quats, log_scales, opacity_logits))
        _core.apply_offsets_forward(
            points, quats, log_scales, opacity_logits, raw, instruction_set(), thread_count(), *activated
        )
        ctx.save_for_backward(quats, log_scales, raw, activated[2], activated[3])
        return activated

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        quats, log_scales, raw, scales, opacities = ctx.saved_tensors
        gradients = _Gradients(*(torch.empty_like(tensor) for tensor in (quats, log_scales, opacities, raw)))
        _core.apply_offsets_backward(
            quats,
            log_scales,
            raw,
            scales,
            opacities,
            **{f"by_{name}": grad.contiguous() for name, grad in zip(_ACTIVATED, upstream, strict=True)},
            simd=instruction_set(),
            threads=thread_count(),
            **{f"grad_{name}": gradient for name, gradient in gradients._asdict().items()},
        )
        return upstream[0] if ctx.needs_input_grad[0] else None, *gradients
