"""D-SSIM on the CPU by the compiled kernel, as an autograd function."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.compute.native import instruction_set, thread_count


def dssim_cpu(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """`photometric.dssim` of float32 tensors on the CPU of at least 11 x 11 pixels, differentiable in `image`.

    Value and gradient are computed together, in double precision: a variance is a difference of nearly equal numbers.
    They are the same to the last bit for any number of threads (torch.get_num_threads(), or AVATAR_THREADS).
    """
    return _Dssim.apply(image, target, mask)  # pyright: ignore


class _Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        image, target, mask = (tensor.detach().contiguous() for tensor in arguments)
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        value = _core.dssim(image, target, mask, instruction_set(), thread_count(), gradient)
        ctx.save_for_backward(gradient)
        return image.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad, None, None
