"""From a triangle mesh to pixels: which face every pixel shows. Imports no PyTorch: `avatar doctor` calls it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar import _core


class MeshRaster(NamedTuple):
    face_id: np.ndarray  # int32 [H, W], -1 where no triangle covers the pixel's centre
    barycentric: np.ndarray  # float32 [H, W, 3], perspective-correct
    depth: np.ndarray  # float32 [H, W], 0 where no triangle


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
