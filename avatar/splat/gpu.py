"""Splatting on a GPU by the kernels of `avatar.kernels`, as an autograd function.

A drawing reads nothing back, apart from the first of its kind and checked ones (see `gpu_buffers`). So a value that is not
finite, a colour that overflows or more pairs of tile and splat than the buffers hold cannot raise: image and alpha are NaN
where it draws.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.compute.device import to_device
from avatar.splat.gpu_backward import backward
from avatar.splat.gpu_draw import Settings, draw
from avatar.splat.options import Options
from avatar.splat.pose import pose_of
from avatar.types import Camera, FeatureGaussians, Gaussians, Rendering


def splat_gpu(
    gaussians: Gaussians | FeatureGaussians, camera: Camera, background: Float[Tensor, " C"], options: Options
) -> Rendering:
    """`avatar.splat.splat` and `splat_features` without their checks of shape and type; float32 tensors on a GPU."""
    device = gaussians.means.device
    pose, settings = pose_on(camera, device), settings_of(camera, device, options)
    image, alpha = _Splat.apply(gaussians._make, *gaussians, background, pose, settings)  # pyright: ignore
    return Rendering(image, alpha)


def settings_of(camera: Camera, device: torch.device, options: Options) -> Settings:
    return Settings(intrinsics_on(camera, options.blur, options.near, device), camera.width, camera.height, options)


def pose_on(camera: Camera, device: torch.device) -> Float[Tensor, " 12"]:
    """`pose_of`; of a camera on the CPU without a gradient, one copy, the first time."""
    R, t = camera.R_cam_world, camera.t_cam_world
    if R.is_cpu and t.is_cpu and not (R.requires_grad or t.requires_grad):
        return _uploaded((*R.flatten().tolist(), *t.tolist()), device)
    return pose_of(camera, device)


def intrinsics_on(camera: Camera, blur: float, near: float, device: torch.device) -> Float[Tensor, " 10"]:
    """What the kernels need of a camera besides, in the order of `avatar.kernels.geometry`; one copy, the first time."""
    slopes: list[float] = []
    for focal, centre, size in ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)):
        margin = 0.3 * 0.5 * size / focal
        slopes += [-centre / focal - margin, (size - centre) / focal + margin]
    values = (camera.fx, camera.fy, camera.cx, camera.cy, *slopes, blur, near)
    if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        return _kept(values, device)
    return _uploaded(values, device)


@lru_cache(maxsize=8192)  # the frames of a training come again
def _uploaded(values: tuple[float, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # backward passes may save it later
        return to_device(torch.tensor(values, dtype=torch.float64), device)


@cache  # for good: a CUDA graph reads them
def _kept(values: tuple[float, ...], device: torch.device) -> Tensor:
    return _uploaded(values, device)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        make, *inputs, background, pose, settings = arguments
        gaussians, background = make(t.detach().contiguous() for t in inputs), background.detach().contiguous()
        pose = pose.detach()
        ctx.make, ctx.settings, ctx.drawing = make, settings, None
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*gaussians, background, pose)
        if len(gaussians.means) == 0:
            image = background.repeat(settings.height, settings.width, 1)
            return image, torch.zeros_like(image[..., 0])
        (image, alpha), ctx.drawing = draw(gaussians, pose, background, settings)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, background, pose = ctx.saved_tensors
        gaussians, drawing = ctx.make(tensors), ctx.drawing
        *_, wants_background, wants_pose, _ = ctx.needs_input_grad
        if drawing is None:
            gradients = [torch.zeros_like(t) for t in gaussians]
            by_pose = torch.zeros_like(pose) if wants_pose else None
            rest = torch.ones_like(background[0])
        else:
            inputs = gaussians, pose, background, ctx.settings, drawing
            gradients, by_pose = backward(*inputs, grad_image, grad_alpha, wants_pose=wants_pose)
            rest = drawing.transmittances[..., None]
        by_background = None
        if wants_background:
            by_background = torch.zeros_like(background) if grad_image is None else (grad_image * rest).sum((0, 1))
        return None, *gradients, by_background, by_pose, None
