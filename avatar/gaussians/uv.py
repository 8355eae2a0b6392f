"""Which triangle of a mesh each texel of its UV map lies in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import KDTree
from torch import Tensor

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.features import eyeballs, openings
from avatar.head.rasterize import rasterize_mesh

DETAILED = ("lips", "left_eyeball", "right_eyeball")  # region names of FLAME_masks.pkl; what moves most is about them
REACH = 0.012  # metres from them, on the template: lids, lashes and the corners of the mouth are within it
REACH_OF_OPENINGS = 0.02  # where only the mouth's opening is known, which lies behind the lips

FINEST = 2048  # texels a side, of a raster and of a detailed one


class UVTexels(NamedTuple):
    """The covered texels of a raster of the UV map, row by row from the top; where it is finer, after the others.

    Those whose row is at or beyond `side` lie below the map.
    """

    row: Int[Tensor, " N"]
    column: Int[Tensor, " N"]
    face: Int[Tensor, " N"]
    barycentric: Float[Tensor, "N 3"]
    side: Int[Tensor, " N"]  # of the texel's raster, in texels: row and column count on it


def uv_texels(assets: HeadAssets, size: int, detail: int = 1) -> UVTexels:
    """Texels of a `size` x `size` raster whose centre lies in a triangle of the UV layout; about mouth and eyes
    those of one that is `detail` times as fine.

    Row 0 is the top of the map (v = 1). Texels of a triangle that touches the region `boundary` (the rim of the neck) are
    left out, as in FlashAvatar. Raises ValueError when nothing is covered, UserError for a raster that is too fine.
    """
    coarse = _raster(assets, size)
    if len(coarse.row) == 0:
        raise ValueError(f"no texel of a {size} x {size} raster lies in the head model's UV layout")
    if detail == 1:
        return coarse
    if size * detail > FINEST:
        raise UserError(
            f"model.uv_size={size} times model.uv_detail={detail} is {size * detail} texels a side: at most {FINEST} are "
            "possible; lower one of them"
        )
    fine, is_detailed = _raster(assets, size * detail), detailed_faces(assets)
    outside, inside = ~is_detailed[coarse.face], is_detailed[fine.face]
    return UVTexels(*(torch.cat((a[outside], b[inside])) for a, b in zip(coarse, fine, strict=True)))


def bound_texels(assets: HeadAssets, mesh: HeadAssets, size: int, detail: int) -> UVTexels:
    """What an avatar's Gaussians are bound to: `uv_texels`, and of a `mesh` that goes on after the head model's triangles
    (`avatar.head.teeth`) the texels of those, as fine as about the mouth."""
    texels, first = uv_texels(assets, size, detail), len(assets.faces)
    if len(mesh.faces) == first:
        return texels
    added = replace(mesh, faces=mesh.faces[first:], uv_faces=mesh.uv_faces[first:])
    more = _raster(added, size * detail, 1.0 - float(mesh.uvs[added.uv_faces, 1].min()))
    return UVTexels(*(torch.cat(both) for both in zip(texels, more._replace(face=more.face + first), strict=True)))


def detailed_faces(assets: HeadAssets) -> Bool[Tensor, " F"]:
    """The triangles that lie within REACH of lips and eyeballs; where the head model names neither, about what turns with
    the eyes and about the openings of the face. None where there is nothing of that either."""
    named = [assets.regions[name] for name in DETAILED if len(assets.regions.get(name, ()))]
    if named:
        near = _within(assets, torch.cat(named), REACH)
    else:
        near = _within(assets, eyeballs(assets), REACH) | _within(assets, openings(assets), REACH_OF_OPENINGS)
    return near[assets.faces].all(dim=1)


def _within(assets: HeadAssets, vertices: Int[Tensor, " R"], reach: float) -> Bool[Tensor, " V"]:
    """The vertices within so many metres of these, on the template."""
    if len(vertices) == 0:
        return torch.zeros(assets.num_vertices, dtype=torch.bool)
    points = assets.template.numpy()
    distances = KDTree(points[vertices.numpy()]).query(points, distance_upper_bound=reach)[0]
    return torch.from_numpy(np.isfinite(distances))


def painted(
    texels: UVTexels, values: Shaped[np.ndarray, "N C"]
) -> tuple[Shaped[np.ndarray, "S S C"], Bool[np.ndarray, "S S"]]:
    """The values as a map, S the side of the finest raster, and where there are any; 0 elsewhere.

    Texels below the map are left out. A coarse texel whose centre lies where the raster is finer has no Gaussian, so half
    of one may stay empty beside it.
    """
    size = int(texels.side.max())
    image, covered = np.zeros((size, size, values.shape[1]), values.dtype), np.zeros((size, size), bool)
    for side in texels.side.unique().tolist():
        own, times = ((texels.side == side) & (texels.row < side)).numpy(), size // side
        for i in range(times):
            for j in range(times):
                place = texels.row.numpy()[own] * times + i, texels.column.numpy()[own] * times + j
                image[place], covered[place] = values[own], True
    return image, covered


def _raster(assets: HeadAssets, size: int, sides: float = 1.0) -> UVTexels:
    """The texels of one raster, which reaches down so many sides of the map."""
    uv = assets.uvs.numpy()
    flat = np.stack((uv[:, 0] * size, (1.0 - uv[:, 1]) * size, np.ones(len(uv), np.float32)), axis=1)
    raster = rasterize_mesh(flat, assets.uv_faces.numpy(), math.ceil(sides * size), size)
    covered = raster.face_id >= 0
    if "boundary" in assets.regions:
        on_rim = np.isin(assets.faces.numpy(), assets.regions["boundary"].numpy()).max(axis=1)
        covered &= ~on_rim[raster.face_id]
    row, column = np.nonzero(covered)
    return UVTexels(
        torch.from_numpy(row),
        torch.from_numpy(column),
        torch.from_numpy(raster.face_id[covered].astype(np.int64)),
        torch.from_numpy(raster.barycentric[covered]),
        torch.full((len(row),), size),
    )
