"""Splatting on a GPU by the kernels of `avatar.kernels`, as an autograd function.

A drawing reads nothing back, apart from the first of its kind (see `capacity`). So a value that is not finite, a colour
that overflows or more pairs of tile and splat than there is room for cannot raise: image and alpha are NaN where it draws.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.compute.device import brought
from avatar.kernels.geometry import VIEW_VALUES
from avatar.splat.gpu_draw import Settings, backward, draw
from avatar.splat.region import Region
from avatar.types import Camera, Gaussians, Rendering


def splat_gpu(gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], **options: Any) -> Rendering:
    """`avatar.splat.splat` without its checks of shape and type; float32 tensors on a GPU."""
    settings = settings_of(camera, gaussians.means.device, **options)
    image, alpha = _Splat.apply(*gaussians, background, settings)  # pyright: ignore
    return Rendering(image, alpha)


def settings_of(
    camera: Camera, device: torch.device, *, blur: float, near: float, region: Region, **options: Any
) -> Settings:
    view = view_block(camera, blur, near, device) if _fixed_view is None else _fixed_view
    return Settings(view, camera.width, camera.height, region, **options)


_fixed_view: Float[Tensor, " 25"] | None = None


@contextmanager
def fixed_view(view: Float[Tensor, " 25"]) -> Iterator[None]:
    """Draw from where `view` says, which `view_block` made; of the camera only its size counts. So a CUDA graph that has
    captured a drawing can draw from elsewhere."""
    global _fixed_view
    before, _fixed_view = _fixed_view, view
    try:
        yield
    finally:
        _fixed_view = before


def view_block(camera: Camera, blur: float, near: float, device: torch.device) -> Float[Tensor, " 25"]:
    """What the kernels need of a camera, in the order of `avatar.kernels.geometry`; one copy, the first time."""
    rotation, translation = camera.R_cam_world.double().flatten().tolist(), camera.t_cam_world.double().tolist()
    slopes: list[float] = []
    for focal, centre, size in ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)):
        margin = 0.3 * 0.5 * size / focal
        slopes += [-centre / focal - margin, (size - centre) / focal + margin]
    eye = [-sum(rotation[3 * row + column] * translation[row] for row in range(3)) for column in range(3)]
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    values = [*rotation, *translation, *intrinsics, *slopes, *eye, blur, near]
    assert len(values) == VIEW_VALUES
    return _uploaded(tuple(values), device)


@lru_cache(maxsize=8192)  # the frames of a training come again
def _uploaded(values: tuple[float, ...], device: torch.device) -> Tensor:
    return brought(torch.tensor(values, dtype=torch.float64), device)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *inputs, background, settings = arguments
        gaussians, background = Gaussians(*(t.detach().contiguous() for t in inputs)), background.detach().contiguous()
        ctx.settings, ctx.drawing = settings, None
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*gaussians, background)
        if len(gaussians.means) == 0:
            image = background.repeat(settings.height, settings.width, 1)
            return image, torch.zeros_like(image[..., 0])
        (image, alpha), ctx.drawing, _ = draw(gaussians, background, settings)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, background = ctx.saved_tensors
        gaussians, drawing = Gaussians(*tensors), ctx.drawing
        if drawing is None:
            gradients = Gaussians(*(torch.zeros_like(t) for t in gaussians))
            rest = torch.ones_like(background[0])
        else:
            gradients = backward(gaussians, background, ctx.settings, drawing, grad_image, grad_alpha)
            rest = drawing.transmittances[..., None]
        by_background = None
        if ctx.needs_input_grad[5]:
            by_background = torch.zeros_like(background) if grad_image is None else (grad_image * rest).sum((0, 1))
        return *gradients, by_background, None
