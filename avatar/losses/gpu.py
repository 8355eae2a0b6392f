"""The training loss on a GPU: value and gradient in a few launches, summed in a fixed order."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.kernels.huber import huber, huber_backward
from avatar.kernels.launch import start
from avatar.kernels.reduce import finish
from avatar.kernels.ssim import WINDOW, compare, smooth_rows, spread_columns, spread_rows

LANES = 256  # values of a program
WARPS = 4
ROWS = 1024  # of the programs' shares that are added up at a time


def huber_gpu(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W"],
    *,
    delta: float,
    mask_weight: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Huber loss of the frame, and `mask_weight` times that of both images times the mask; means over the whole frame.

    Float32 tensors on one GPU; differentiable in `image`.
    """
    return _Huber.apply(image, target, mask, delta, mask_weight)  # pyright: ignore


class _Huber(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        image, target, mask = (tensor.detach().contiguous() for tensor in arguments[:3])
        delta, mask_weight = arguments[3:]
        values = image.numel()
        programs = -(-values // LANES)
        scales = constants((1 / values, mask_weight / values), torch.float64, image.device)
        partial, sums = image.new_empty(programs, 2), image.new_empty(2)
        start(huber, programs, image, target, mask, delta, values, partial, warps=WARPS, BLOCK=LANES)
        start(finish, 1, partial, scales, programs, sums, warps=WARPS, COLUMNS=2, BLOCK=ROWS)
        ctx.save_for_backward(image, target, mask)
        ctx.delta, ctx.scales = delta, scales
        return sums[0], sums[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_frame: Tensor, by_mask: Tensor) -> tuple[Tensor | None, ...]:
        image, target, mask = ctx.saved_tensors
        gradient, values = torch.empty_like(image), image.numel()
        upstream = ctx.scales, by_frame.contiguous(), by_mask.contiguous()
        start(
            huber_backward,
            -(-values // LANES),
            *(image, target, mask, ctx.delta),
            *upstream,
            values,
            gradient,
            warps=WARPS,
            BLOCK=LANES,
        )
        return gradient, None, None, None, None


def dssim_gpu(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """`avatar.losses.dssim` of float32 tensors on a GPU of at least 11 x 11 pixels, differentiable in `image`."""
    return _Dssim.apply(image, target, mask)  # pyright: ignore


class _Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        image, target, mask = (tensor.detach().contiguous() for tensor in arguments)
        height, width = mask.shape
        border = WINDOW.value - 1
        down, across = height - border, width - border
        window = constants(gaussian_window(), torch.float32, image.device)
        pair = image, target, mask
        maps = image.new_empty(4, height, across, 3)
        programs = -(-maps[0].numel() // LANES)
        start(smooth_rows, programs, *pair, window, height, width, maps, warps=WARPS, BLOCK=LANES)
        compared = -(-3 * down * across // LANES)
        wanted = ctx.needs_input_grad[0]
        partial, slopes = image.new_empty(compared), image.new_empty(3, down, across, 3) if wanted else maps
        start(
            compare,
            compared,
            *(maps, window, height, width, partial, slopes),
            warps=WARPS,
            GRADIENT=wanted,
            BLOCK=LANES,
        )
        scale = 1 / (2 * 3 * down * across)
        scales = constants((scale,), torch.float64, image.device)
        value = image.new_empty(1)
        start(finish, 1, partial, scales, compared, value, warps=WARPS, COLUMNS=1, BLOCK=ROWS)
        gradient = None
        if wanted:
            spread, gradient = image.new_empty(3, height, across, 3), torch.empty_like(image)
            start(spread_columns, programs, slopes, window, height, width, spread, warps=WARPS, BLOCK=LANES)
            start(
                spread_rows,
                -(-image.numel() // LANES),
                *(spread, *pair, window, -scale, height, width, gradient),
                warps=WARPS,
                BLOCK=LANES,
            )
        ctx.save_for_backward(gradient)
        return value[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad, None, None


def gaussian_window() -> tuple[float, ...]:
    """SSIM's 11 weights, sigma 1.5; their sum is 1."""
    radius = WINDOW.value // 2
    weights = [math.exp(-0.5 * (k / 1.5) ** 2) for k in range(-radius, radius + 1)]
    return tuple(weight / sum(weights) for weight in weights)


@cache  # for good: a CUDA graph may read them
def constants(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers that kernels read, brought to the GPU once."""
    return torch.tensor(values, dtype=dtype).to(device)
