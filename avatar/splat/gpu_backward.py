"""The launches of a drawing's gradients on a GPU; no autograd, and nothing that waits."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.kernels.composite_backward import MOMENTS, composite_backward
from avatar.kernels.geometry import POSE_VALUES
from avatar.kernels.launch import start
from avatar.kernels.project_backward import colour_of_backward, project_backward, sum_moments
from avatar.splat.gpu_draw import Drawing, Settings, programs
from avatar.types import Gaussians


def backward(
    gaussians: Gaussians,
    pose: Float[Tensor, " 12"],
    background: Float[Tensor, " 3"],
    settings: Settings,
    drawing: Drawing,
    grad_image: Float[Tensor, "H W 3"] | None,
    grad_alpha: Float[Tensor, "H W"] | None,
    *,
    wants_pose: bool,
) -> tuple[Gaussians, Float[Tensor, " 12"] | None]:
    """The gradients of all fields, and that of the pose if it is wanted; four launches, and one more for the pose."""
    s, d, N, tuning = settings, drawing, len(gaussians.means), drawing.tuning
    stride = d.records.shape[1]
    moments = torch.empty((stride, MOMENTS.value), dtype=torch.float32, device=background.device)
    # The moments stand for a cotangent that the kernel does not read.
    by_image, by_alpha = (moments if g is None else g.contiguous() for g in (grad_image, grad_alpha))
    start(
        composite_backward,
        d.grid.tiles,
        *(d.records, d.begins, d.chunks, background, d.transmittances, d.stops, by_image, by_alpha),
        *(s.alpha_min, s.alpha_max, stride, s.width, *d.grid.place, *s.region, moments),
        warps=tuning.backward_warps,
        HAS_IMAGE=grad_image is not None,
        HAS_ALPHA=grad_alpha is not None,
        TILE=tuning.tile,
        CHUNK=tuning.chunk,
        STEP=tuning.backward_step,
        FORWARD_STEP=tuning.step,
    )
    sums = torch.empty((MOMENTS.value, N), dtype=torch.float64, device=background.device)
    start(
        sum_moments,
        programs(N, tuning.summed),
        *(d.order, d.ends, d.boxes, d.places, moments, N, d.capacity, sums),
        warps=1,
        LANES=tuning.summed_lanes,
        BLOCK=tuning.summed,
    )
    gradients = Gaussians(*(torch.empty_like(t) for t in gaussians))
    warps = max(tuning.backward_lanes // 32, 1)
    start(
        colour_of_backward,
        programs(N, tuning.backward_lanes),
        *(gaussians.means, gaussians.sh, pose, sums, s.sh_degree, N, gradients.means, gradients.sh),
        warps=warps,
        STORED=gaussians.sh.shape[1],
        BLOCK=tuning.backward_lanes,
    )
    number = programs(N, tuning.backward_lanes)
    by_pose = torch.empty((number, POSE_VALUES.value), dtype=torch.float64, device=pose.device) if wants_pose else sums
    start(
        project_backward,
        number,
        *(*gaussians[:4], pose, s.intrinsics, sums, N, *gradients[:4], by_pose),  # by_pose is not written without POSE
        warps=warps,
        ANTIALIASED=s.antialiased,
        POSE=wants_pose,
        BLOCK=tuning.backward_lanes,
    )
    return gradients, by_pose.sum(0) if wants_pose else None
