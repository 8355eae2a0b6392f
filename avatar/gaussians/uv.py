"""Which triangle of a mesh each texel of its UV map lies in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.rasterize import rasterize_mesh


class UVTexels(NamedTuple):
    """The covered texels of an S x S raster of the UV map, row by row from the top."""

    row: Int[Tensor, " N"]
    column: Int[Tensor, " N"]
    face: Int[Tensor, " N"]
    barycentric: Float[Tensor, "N 3"]


def uv_texels(assets: HeadAssets, size: int) -> UVTexels:
    """Texels of a `size` x `size` raster whose centre lies in a triangle of the UV layout.

    Row 0 is the top of the map (v = 1). Texels of a triangle that touches the region `boundary` (the rim of the neck) are
    left out, as in FlashAvatar. Raises ValueError when nothing is covered.
    """
    if size < 1:
        raise ValueError(f"the UV raster must have at least one texel a side, got {size}")
    uv = assets.uvs.numpy()
    flat = np.stack((uv[:, 0] * size, (1.0 - uv[:, 1]) * size, np.ones(len(uv), np.float32)), axis=1)
    raster = rasterize_mesh(flat, assets.uv_faces.numpy(), size, size)
    covered = raster.face_id >= 0
    if "boundary" in assets.regions:
        on_rim = np.isin(assets.faces.numpy(), assets.regions["boundary"].numpy()).max(axis=1)
        covered &= ~on_rim[raster.face_id]
    row, column = np.nonzero(covered)
    if len(row) == 0:
        raise ValueError(f"no texel of a {size} x {size} raster lies in the head model's UV layout")
    return UVTexels(
        torch.from_numpy(row),
        torch.from_numpy(column),
        torch.from_numpy(raster.face_id[covered].astype(np.int64)),
        torch.from_numpy(raster.barycentric[covered]),
    )
