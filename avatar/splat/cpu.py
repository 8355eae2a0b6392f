"""Splatting on the CPU by the compiled kernel, as an autograd function."""

from __future__ import annotations

import os
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.check import check_finite
from avatar.types import Camera, Gaussians, Rendering


def splat_cpu(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"],
    *,
    sh_degree: int,
    alpha_min: float,
    alpha_max: float,
    t_min: float,
    blur: float,
    near: float,
    antialiased: bool,
) -> Rendering:
    """`avatar.splat.splat` without its checks of shape and type; float32 tensors on the CPU."""
    settings = (
        camera.R_cam_world.flatten().tolist(),
        camera.t_cam_world.tolist(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        sh_degree,
        (alpha_min, alpha_max, t_min),
        blur,
        near,
        antialiased,
        os.environ.get("AVATAR_SIMD", ""),
        thread_count(),
    )
    image, alpha = _Splat.apply(*gaussians, background, (camera.height, camera.width), settings)  # pyright: ignore
    return Rendering(image, alpha)


def thread_count() -> int:
    """Threads that the kernel uses: the variable AVATAR_THREADS, or as many as torch does."""
    text = os.environ.get("AVATAR_THREADS")
    if text is None:
        return torch.get_num_threads()
    if not text.isdigit() or not 1 <= int(text) <= 1024:
        raise ValueError(f"AVATAR_THREADS must be a number of threads from 1 to 1024, got {text!r}")
    return int(text)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *inputs, size, settings = arguments
        inputs = [tensor.detach().contiguous() for tensor in inputs]
        image = torch.empty((*size, 3), dtype=torch.float32)
        alpha = torch.empty(size, dtype=torch.float32)
        drawing = _core.splat_forward(*inputs, *settings, image, alpha)
        if drawing is None:
            check_finite(**dict(zip((*Gaussians._fields, "background"), inputs, strict=True)))
        ctx.drawing = drawing
        ctx.save_for_backward(*inputs[:-1], image)
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        *inputs, image = ctx.saved_tensors
        gradients = [torch.empty_like(tensor) for tensor in inputs]
        grad_background = torch.empty(3, dtype=torch.float32)
        cotangents = [None if grad is None else grad.contiguous() for grad in (grad_image, grad_alpha)]
        _core.splat_backward(ctx.drawing, *inputs, image, *cotangents, *gradients, grad_background)
        return *gradients, grad_background, None, None
