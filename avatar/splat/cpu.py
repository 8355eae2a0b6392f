"""Splatting on the CPU by the compiled kernel, as an autograd function."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.compute.native import instruction_set, thread_count
from avatar.splat.options import Options
from avatar.splat.pose import pose_of
from avatar.tensors import describe_non_finite
from avatar.types import Camera, FeatureGaussians, Gaussians, Rendering


class CannotDraw(ValueError):
    """The values of the Gaussians are at fault: one is not finite, a colour overflows, or they are too large."""


def splat_cpu(
    gaussians: Gaussians | FeatureGaussians, camera: Camera, background: Float[Tensor, " C"], options: Options
) -> Rendering:
    """`avatar.splat.splat` and `splat_features` without their checks of shape and type; float32 tensors on the CPU."""
    pose, settings = pose_of(camera, gaussians.means.device), _settings(camera, options)
    size = camera.height, camera.width
    image, alpha = _Splat.apply(gaussians._make, *gaussians, background, pose, size, settings)  # pyright: ignore
    return Rendering(image, alpha)


def _settings(camera: Camera, options: Options) -> dict[str, Any]:
    """All arguments of the compiled function that are not tensors."""
    return {
        "rotation": camera.R_cam_world.flatten().tolist(),
        "translation": camera.t_cam_world.tolist(),
        "intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy),
        "sh_degree": -1 if options.sh_degree is None else options.sh_degree,  # -1: features
        "cutoffs": (options.alpha_min, options.alpha_max, options.t_min),
        "blur": options.blur,
        "near": options.near,
        "antialiased": options.antialiased,
        "region": options.region,
        "simd": instruction_set(),
        "threads": thread_count(),
    }


def _draw(
    gaussians: Gaussians | FeatureGaussians, background: Tensor, size: tuple[int, int], settings: dict[str, Any]
) -> tuple[Tensor, Tensor, _core.Drawing]:
    image = torch.empty((*size, len(background)), dtype=torch.float32)
    alpha = torch.empty(size, dtype=torch.float32)
    try:
        drawing = _core.splat_forward(*gaussians, background.contiguous(), **settings, image=image, alpha=alpha)
    except ValueError as error:  # colours that overflow, too many splats to a tile; types and shapes are checked before
        raise CannotDraw(str(error)) from None
    if drawing is None:
        for name, tensor in {**gaussians._asdict(), "background": background}.items():
            if message := describe_non_finite(name, tensor):
                raise CannotDraw(message)
        raise AssertionError("the kernel found a value that is not finite")
    return image, alpha, drawing


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        make, *inputs, background, _, size, settings = arguments
        gaussians = make(t.detach().contiguous() for t in inputs)
        image, alpha, drawing = _draw(gaussians, background.detach(), size, settings)
        ctx.drawing, ctx.channels = drawing, len(background)
        ctx.save_for_backward(*gaussians)
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        gaussians = ctx.saved_tensors
        gradients = [torch.empty_like(t) for t in gaussians]
        grad_background = torch.empty(ctx.channels, dtype=torch.float32)
        grad_pose = torch.empty(12, dtype=torch.float64) if ctx.needs_input_grad[7] else None
        cotangents = (None if grad is None else grad.contiguous() for grad in (grad_image, grad_alpha))
        arguments: list[Any] = [ctx.drawing, *gaussians, *cotangents, *gradients]
        _core.splat_backward(*arguments, grad_background=grad_background, grad_pose=grad_pose)
        return None, *gradients, grad_background, grad_pose, None, None
