"""Splatting on the CPU by the compiled kernel, as an autograd function."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.compute.native import instruction_set, thread_count
from avatar.splat.pose import pose_of
from avatar.splat.region import Region
from avatar.tensors import describe_non_finite
from avatar.types import Camera, Gaussians, Rendering


class CannotDraw(ValueError):
    """The values of the Gaussians are at fault: one is not finite, a colour overflows, or they are too large."""


def splat_cpu(gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], **options: Any) -> Rendering:
    """`avatar.splat.splat` without its checks of shape and type; float32 tensors on the CPU."""
    size, pose = (camera.height, camera.width), pose_of(camera, gaussians.means.device)
    image, alpha = _Splat.apply(*gaussians, background, pose, size, _settings(camera, **options))  # pyright: ignore
    return Rendering(image, alpha)


def _settings(
    camera: Camera,
    *,
    sh_degree: int,
    alpha_min: float,
    alpha_max: float,
    t_min: float,
    blur: float,
    near: float,
    antialiased: bool,
    region: Region,
) -> dict[str, Any]:
    """All arguments of the compiled function that are not tensors."""
    return {
        "rotation": camera.R_cam_world.flatten().tolist(),
        "translation": camera.t_cam_world.tolist(),
        "intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy),
        "sh_degree": sh_degree,
        "cutoffs": (alpha_min, alpha_max, t_min),
        "blur": blur,
        "near": near,
        "antialiased": antialiased,
        "region": region,
        "simd": instruction_set(),
        "threads": thread_count(),
    }


def _draw(
    gaussians: Gaussians, background: Tensor, size: tuple[int, int], settings: dict[str, Any]
) -> tuple[Tensor, Tensor, _core.Drawing]:
    image = torch.empty((*size, 3), dtype=torch.float32)
    alpha = torch.empty(size, dtype=torch.float32)
    try:
        drawing = _core.splat_forward(
            **gaussians._asdict(), background=background.contiguous(), **settings, image=image, alpha=alpha
        )
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
        *inputs, background, _, size, settings = arguments
        gaussians = Gaussians(*(t.detach().contiguous() for t in inputs))
        image, alpha, drawing = _draw(gaussians, background.detach(), size, settings)
        ctx.drawing = drawing
        ctx.save_for_backward(*gaussians)
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        gaussians = Gaussians(*ctx.saved_tensors)
        gradients = Gaussians(*(torch.empty_like(t) for t in gaussians))
        grad_background = torch.empty(3, dtype=torch.float32)
        grad_pose = torch.empty(12, dtype=torch.float64) if ctx.needs_input_grad[6] else None
        _core.splat_backward(
            ctx.drawing,
            **gaussians._asdict(),
            grad_image=None if grad_image is None else grad_image.contiguous(),
            grad_alpha=None if grad_alpha is None else grad_alpha.contiguous(),
            **{f"grad_{name}": gradient for name, gradient in gradients._asdict().items()},
            grad_background=grad_background,
            grad_pose=grad_pose,
        )
        return *gradients, grad_background, grad_pose, None, None
