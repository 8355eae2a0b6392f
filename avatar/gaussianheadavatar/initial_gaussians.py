"""Where the Gaussians start: on the mesh, on the surface that training pictures show beyond it, and in the mouth."""

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
from avatar.gaussianheadavatar.start_points import knn_log_scales, mouth_box, spread_points, visual_hull
from avatar.gaussians.initial_colours import mean_colours, mean_of, seen_at
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import UVTexels
from avatar.head.model import HeadModel

REACH = 1.8  # of the surface's box from the head's centre, half head lengths
CELLS = 64  # of the box, a side
APART = 0.004  # metres from the mesh from which the surface counts as beyond it
MOUTH_SHARE = 0.1  # of the points beyond the mesh
MOUTH_COLOUR = 0.3  # dark: a mouth's inside
UNSEEN = 0.5  # grey


class InitialGaussians(NamedTuple):
    positions: Float[Tensor, "N 3"]  # metres, head at rest
    log_scales: Float[Tensor, "N 3"]
    colours: Float[Tensor, "N 3"]  # in [0, 1]


def initial_gaussians(
    head: HeadModel, texels: UVTexels, frames: Sequence[Frame], count: int, centre: Float[Tensor, 3], half: float
) -> InitialGaussians:
    """`count` points, those of `texels` first; `centre` and `half` say where the head is and half its length, metres.

    Raises UserError for masks that leave no common hull.
    """
    embedding = Embedding(head.assets, texels)
    on_mesh = embedding.points(head.neutral_vertices())
    colours, seen = mean_colours(head, embedding, frames)
    colours[~seen] = UNSEEN
    rest = count - len(on_mesh)
    in_mouth = round(MOUTH_SHARE * rest)
    beyond = beyond_mesh(head, embedding, frames, centre, half)
    outside = spread_points(beyond, rest - in_mouth)
    lips = head.neutral_vertices()[head.assets.regions.get("lips", torch.arange(head.assets.num_vertices))]
    mouth = mouth_box(lips, in_mouth, torch.Generator().manual_seed(0))
    positions = torch.cat((on_mesh, outside, mouth))
    shown = (colours, colours_beyond(head, outside, frames, centre), torch.full_like(mouth, MOUTH_COLOUR))
    return InitialGaussians(positions, knn_log_scales(positions), torch.cat(shown))


def beyond_mesh(
    head: HeadModel, mesh: Embedding, frames: Sequence[Frame], centre: Float[Tensor, 3], half: float
) -> Float[Tensor, "M 3"]:
    """Points of the surface that are not on the mesh; all of its points where it is nowhere beyond it."""
    cell = 2.0 * REACH * half / CELLS
    side = CELLS + 2  # the border is outside
    grid = Grid(centre - 0.5 * cell * (side - 1), cell, (side, side, side))
    try:
        hull = visual_hull([(frame.camera, frame.alpha * frame.head_mask) for frame in frames], grid)
        surface = fit_surface(hull, grid, head, mesh, frames)
    except ValueError as error:
        raise UserError(
            f"the Gaussians have nowhere to start: {error}. The tracking and the masks of the training frames do not "
            "belong together; run avatar check on the folder"
        ) from None
    distance, _ = KDTree(mesh.points(head.neutral_vertices()).numpy()).query(surface.numpy())
    beyond = surface[torch.from_numpy(distance) > APART]
    return beyond if len(beyond) else surface


def colours_beyond(
    head: HeadModel, points: Float[Tensor, "H 3"], frames: Sequence[Frame], centre: Float[Tensor, 3]
) -> Float[Tensor, "H 3"]:
    """The mean colour that the frames show at points beyond the mesh; outwards is away from the head's centre."""
    surface = head.neutral_vertices(), head.faces
    colours, seen = mean_of(len(points), (seen_at(points, points - centre, *surface, frame) for frame in frames))
    colours[~seen] = UNSEEN
    return colours
