"""Where the Gaussians start: on the mesh, beyond it on the training masks' visual hull or a surface, and in the mouth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from avatar.data.frame import Frame
from avatar.errors import UserError
from avatar.gaussianheadavatar.initial_surface import fit_surface
from avatar.gaussianheadavatar.marching_tetrahedra import Grid
from avatar.gaussianheadavatar.start_points import (
    AGREE,
    knn_log_scales,
    mouth_box,
    share_inside,
    spread_points,
    visual_hull,
)
from avatar.gaussians.initial_colours import mean_colours, mean_of, seen_at
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import UVTexels
from avatar.head.features import region_or_all
from avatar.head.model import HeadModel

REACH = 1.8  # of the grid from the head's centre, half head lengths
CELLS = 64  # of the grid, a side
APART = 0.004  # metres from the mesh from which a point counts as beyond it
MOUTH_SHARE = 0.1  # of the points beyond the mesh
MOUTH_COLOUR = 0.3  # dark: a mouth's inside
UNSEEN = 0.5  # grey


class InitialGaussians(NamedTuple):
    positions: Float[Tensor, "N 3"]  # metres, head at rest
    log_scales: Float[Tensor, "N 3"]
    colours: Float[Tensor, "N 3"]  # in [0, 1]


def initial_gaussians(
    head: HeadModel,
    texels: UVTexels,
    frames: Sequence[Frame],
    count: int,
    centre: Float[Tensor, " 3"],
    half: float,
    fitted: bool = False,
) -> InitialGaussians:
    """`count` points, those of `texels` first; `centre` and `half` say where the head is and half its length, metres.

    fitted  take a surface that is fitted to the frames in place of the masks' visual hull

    Raises UserError for masks that leave no common hull.
    """
    embedding = Embedding(head.assets, texels)
    on_mesh = embedding.points(head.neutral_vertices())
    colours, seen = mean_colours(head, embedding, frames)
    colours[~seen] = UNSEEN
    rest = count - len(on_mesh)
    in_mouth = round(MOUTH_SHARE * rest)
    outside = spread_points(beyond_mesh(head, embedding, frames, centre, half, fitted), rest - in_mouth)
    lips = head.neutral_vertices()[region_or_all(head.assets, "lips")]
    mouth = mouth_box(lips, in_mouth, torch.Generator().manual_seed(0))
    positions = torch.cat((on_mesh, outside, mouth))
    shown = (colours, colours_beyond(head, outside, frames, centre), torch.full_like(mouth, MOUTH_COLOUR))
    return InitialGaussians(positions, knn_log_scales(positions), torch.cat(shown))


def beyond_mesh(
    head: HeadModel, mesh: Embedding, frames: Sequence[Frame], centre: Float[Tensor, " 3"], half: float, fitted: bool
) -> Float[Tensor, "M 3"]:
    """Points of hull or surface that are not on the mesh; all of its points where it is nowhere beyond it."""
    cell = 2.0 * REACH * half / CELLS
    side = CELLS + 2  # the border is outside
    grid = Grid(centre - 0.5 * cell * (side - 1), cell, (side, side, side))
    vertices = head.neutral_vertices()
    on_mesh = mesh.points(vertices)
    try:
        share = share_inside([(frame.camera, frame.alpha * frame.head_mask) for frame in frames], grid)
        if fitted:
            points = fit_surface(share > AGREE, grid, head, mesh, frames)
            on_mesh = torch.cat((on_mesh, vertices, vertices[head.faces].mean(dim=1)))  # as dense as the surface
        else:
            points = visual_hull(share, grid)
    except ValueError as error:
        raise UserError(
            f"the Gaussians have nowhere to start: {error}. The tracking and the masks of the training frames do not "
            "belong together; run avatar check on the folder"
        ) from None
    distance, _ = KDTree(on_mesh.numpy()).query(points.numpy())
    beyond = points[torch.from_numpy(distance) > APART]
    return beyond if len(beyond) else points


def colours_beyond(
    head: HeadModel, points: Float[Tensor, "H 3"], frames: Sequence[Frame], centre: Float[Tensor, " 3"]
) -> Float[Tensor, "H 3"]:
    """The mean colour that the frames show at points beyond the mesh; outwards is away from the head's centre."""
    surface = head.neutral_vertices(), head.faces
    colours, seen = mean_of(len(points), (seen_at(points, points - centre, *surface, frame) for frame in frames))
    colours[~seen] = UNSEEN
    return colours
