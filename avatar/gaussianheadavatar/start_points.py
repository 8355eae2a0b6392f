"""Geometry to start from: the surface that the masks of many views leave, points in the mouth, and their first sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from avatar.gaussianheadavatar.marching_tetrahedra import Grid
from avatar.gaussians.mesh_embedding import knn_scales
from avatar.types import Camera

View = tuple[Camera, Tensor]  # and its mask [H, W], 1 inside, of any size
AGREE = 0.9  # share of the views whose masks hold what is inside
MOUTH_SIZE = 0.8  # the box reaches so many extents of the lips to both sides of its centre
JITTER = 1e-3  # of the points' extent, between points that are taken twice
HALVINGS = 20  # of the search for a voxel's size


def share_inside(views: Sequence[View], grid: Grid) -> Float[Tensor, "X Y Z"]:
    """The masks' mean at each point of the grid, over the views whose image holds it.

    0 on the grid's border, which closes the surface, and where fewer than half of the views see the point. Raises
    ValueError where no point lies in the masks of 90 % of the views.
    """
    places = grid.points()
    inside, seen = torch.zeros(len(places)), torch.zeros(len(places))
    for camera, mask in views:
        x, y, depth = camera.project(places).unbind(-1)
        place = torch.stack((2.0 * x / camera.width - 1.0, 2.0 * y / camera.height - 1.0), dim=-1)
        is_seen = (depth > 0) & (place.abs() <= 1.0).all(dim=-1)
        place = place[is_seen][None, None]
        values = grid_sample(mask[None, None].float().cpu(), place, padding_mode="border", align_corners=False)
        inside[is_seen] += values[0, 0, 0]
        seen += is_seen
    share = torch.where(2.0 * seen >= len(views), inside / seen.clamp(min=1.0), 0.0).reshape(grid.shape)
    share = pad(share[1:-1, 1:-1, 1:-1], (1,) * 6)
    if not bool((share > AGREE).any()):
        raise ValueError(f"no place in the box lies in the masks of {AGREE:.0%} of the views")
    return share


def visual_hull(share: Float[Tensor, "X Y Z"], grid: Grid) -> Float[Tensor, "M 3"]:
    """The surface of what lies in the masks of at least 90 % of the views that see it; metres.

    Source: marching cubes (Lorensen and Cline, 1987).
    """
    vertices = marching_cubes(share.numpy(), level=AGREE)[0]
    return grid.low + grid.cell * torch.from_numpy(vertices.astype(np.float32))


def spread_points(points: Float[Tensor, "M 3"], count: int) -> Float[Tensor, "count 3"]:
    """`count` of the points, evenly spread and always the same ones: one in each voxel, near its centre.

    More than there are: all of them, then again from the first, moved by a thousandth of their extent.
    """
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    if count > len(points):
        more = points[torch.arange(count - len(points)) % len(points)]
        moves = torch.rand(more.shape, generator=torch.Generator().manual_seed(0)) - 0.5
        return torch.cat((points, more + JITTER * extent * moves.to(points)))
    cloud = points.detach().cpu().double().numpy()
    cloud = (cloud - cloud.min(axis=0)) / (extent or 1.0)
    chosen, small, large = np.arange(len(cloud)), 0.0, 2.0  # the voxels' size, of the extent
    for _ in range(HALVINGS):
        middle = 0.5 * (small + large)
        candidates = _one_in_each_voxel(cloud, middle)
        if len(candidates) < count:
            large = middle
        else:
            small, chosen = middle, candidates
    # The surplus is small; where points coincide, it is all of them.
    kept = chosen[np.arange(count) * len(chosen) // max(count, 1)]
    return points[torch.from_numpy(kept).to(points.device)]


def _one_in_each_voxel(cloud: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """Of each voxel that holds points in [0, 1], the one nearest to its centre, in the order of the voxels."""
    scaled = cloud / size
    voxels = np.floor(scaled)
    x, y, z = voxels.astype(np.int64).T
    along = int(voxels.max()) + 1  # at most 2^(HALVINGS - 1) + 1, so that its cube fits
    order = np.argsort(np.square(scaled - voxels - 0.5).sum(axis=1), kind="stable")
    return order[np.unique(((x * along + y) * along + z)[order], return_index=True)[1]]


def mouth_box(lips: Float[Tensor, "L 3"], count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Points at random in a box around the lips, which reaches 0.8 of their extent to both sides of its centre.

    The centre is that of the lips' extent, but in depth it is at their back, the smallest z.
    """
    low, high = lips.amin(dim=0), lips.amax(dim=0)
    centre = torch.cat((0.5 * (low + high)[:2], low[2:]))
    random = 2.0 * torch.rand((count, 3), generator=generator).to(lips) - 1.0
    return centre + MOUTH_SIZE * (high - low) * random


def landmarks(vertices: Float[Tensor, "V 3"], face: Int[Tensor, " K"], count: int = 424) -> Float[Tensor, "count 3"]:
    """Evenly spread vertices of the face, whose indices `face` holds: what `nearness` measures distances to."""
    return spread_points(vertices[face], count)


def knn_log_scales(points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """The logarithm of the root mean squared distance to the three nearest neighbours, for all three axes; metres."""
    return knn_scales(points).to(points.device).log()[:, None].repeat(1, 3)
