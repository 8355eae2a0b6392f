"""The launches of a drawing's gradients on a GPU; no autograd, and nothing that waits."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.kernels.composite_backward import MOMENTS, composite_backward
from avatar.kernels.composite_features import composite_features_backward, sum_features
from avatar.kernels.geometry import POSE_VALUES
from avatar.kernels.launch import start
from avatar.kernels.project_backward import colour_of_backward, project_backward, sum_moments
from avatar.splat.gpu_draw import Drawing, Settings, grouped, programs
from avatar.types import FeatureGaussians, Gaussians


def backward(
    gaussians: Gaussians | FeatureGaussians,
    pose: Float[Tensor, " 12"],
    background: Float[Tensor, " C"],
    settings: Settings,
    drawing: Drawing,
    grad_image: Float[Tensor, "H W C"] | None,
    grad_alpha: Float[Tensor, "H W"] | None,
    *,
    wants_pose: bool,
) -> tuple[Gaussians | FeatureGaussians, Float[Tensor, " 12"] | None]:
    """The gradients of all fields, and that of the pose if it is wanted; four launches, and one more for the pose."""
    s, o, d, N, tuning = settings, settings.options, drawing, len(gaussians.means), drawing.tuning
    stride = d.records.shape[1]
    moments = torch.empty((stride, MOMENTS.value), dtype=torch.float32, device=background.device)
    # The moments stand for a cotangent that the kernel does not read.
    by_image, by_alpha = (moments if g is None else g.contiguous() for g in (grad_image, grad_alpha))
    lists = d.records, d.begins, d.chunks
    rest = (background, d.transmittances, d.stops, by_image, by_alpha)
    rest += (o.alpha_min, o.alpha_max, stride, s.width, *d.grid.place, *o.region, moments)
    cut = {"HAS_IMAGE": grad_image is not None, "HAS_ALPHA": grad_alpha is not None, "TILE": tuning.tile}
    cut |= {"CHUNK": tuning.chunk, "STEP": tuning.backward_step, "FORWARD_STEP": tuning.step}
    gradients = gaussians._make(torch.empty_like(t) for t in gaussians)
    if isinstance(gaussians, FeatureGaussians):
        channels = len(background)
        group, number = grouped(channels)
        by_features = torch.empty((stride, channels), dtype=torch.float32, device=background.device)
        start(
            composite_features_backward,
            d.grid.tiles,
            *(*lists, gaussians[4], channels, *rest, by_features),
            warps=tuning.backward_warps,
            GROUP=tuning.backward_group,
            **cut,
        )
        start(
            sum_features,
            programs(N, tuning.summed) * number,
            *(d.order, d.ends, d.boxes, d.places, by_features, channels, N, d.capacity, gradients[4]),
            warps=1,
            GROUP=group,
            LANES=min(tuning.summed_lanes, 16),
            BLOCK=tuning.summed,
        )
    else:
        start(composite_backward, d.grid.tiles, *lists, *rest, warps=tuning.backward_warps, **cut)
    sums = torch.empty((MOMENTS.value, N), dtype=torch.float64, device=background.device)
    start(
        sum_moments,
        programs(N, tuning.summed),
        *(d.order, d.ends, d.boxes, d.places, moments, N, d.capacity, sums),
        warps=1,
        LANES=tuning.summed_lanes,
        BLOCK=tuning.summed,
    )
    warps = max(tuning.backward_lanes // 32, 1)
    if isinstance(gaussians, Gaussians):
        start(
            colour_of_backward,
            programs(N, tuning.backward_lanes),
            *(gaussians.means, gaussians.sh, pose, sums, o.sh_degree, N, gradients[0], gradients[4]),
            warps=warps,
            STORED=gaussians.sh.shape[1],
            BLOCK=tuning.backward_lanes,
        )
    else:
        gradients.means.zero_()  # to which the next adds
    number = programs(N, tuning.backward_lanes)
    by_pose = torch.empty((number, POSE_VALUES.value), dtype=torch.float64, device=pose.device) if wants_pose else sums
    start(
        project_backward,
        number,
        *(*gaussians[:4], pose, s.intrinsics, sums, N, *gradients[:4], by_pose),  # by_pose is not written without POSE
        warps=warps,
        ANTIALIASED=o.antialiased,
        POSE=wants_pose,
        BLOCK=tuning.backward_lanes,
    )
    return gradients, by_pose.sum(0) if wants_pose else None
