"""From a triangle mesh to pixels and back: which face every pixel shows, and what an image shows at points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar import _core


class MeshRaster(NamedTuple):
    face_id: np.ndarray  # int32 [H, W], -1 where no triangle covers the pixel's centre
    barycentric: np.ndarray  # float32 [H, W, 3], perspective-correct
    depth: np.ndarray  # float32 [H, W], 0 where no triangle


def sample_image(image: Float[Tensor, "H W C"], screen: Float[Tensor, "N _"], mode: str) -> Float[Tensor, "N C"]:
    """The image's values at points (x pixel, y pixel, ...), `mode` "nearest" or "bilinear"; zero outside the image."""
    height, width = image.shape[:2]
    grid = screen[:, :2] * torch.tensor([2 / width, 2 / height]) - 1
    # A point in the camera's plane is not in the image.
    grid = grid.nan_to_num(nan=-9.0, posinf=9.0, neginf=-9.0).clamp(-9, 9)
    picked = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid[None, :, None], mode=mode, padding_mode="zeros", align_corners=False
    )
    return picked[0, :, :, 0].T


def rasterize_mesh(screen: np.ndarray, faces: np.ndarray, height: int, width: int) -> MeshRaster:
    """Z-buffer a mesh whose vertices `screen` [V, 3] are (x pixel, y pixel, depth > 0), as `Camera.project` gives.

    A pixel belongs to the nearest triangle that covers its centre (+0.5); both windings are drawn; triangles with a
    vertex behind the camera or a non-finite coordinate are left out. Raises ValueError on a wrong shape or an index out
    of range.
    """
    screen = np.ascontiguousarray(screen, dtype=np.float32)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    if screen.ndim != 2 or screen.shape[1] != 3:
        raise ValueError(f"screen must have shape [V, 3], got {list(screen.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape [F, 3], got {list(faces.shape)}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(screen)):
        raise ValueError(f"faces name vertices {faces.min()} to {faces.max()}, but there are {len(screen)} vertices")
    if height < 1 or width < 1:
        raise ValueError(f"the raster must have at least one pixel, got {height} x {width}")
    raster = MeshRaster(
        np.empty((height, width), np.int32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.float32),
    )
    _core.rasterize_mesh(screen, faces, *raster)
    return raster
