"""From posed meshes to the pixels that a camera sees of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.demo import lighting
from avatar.head.rasterize import MeshRaster
from avatar.types import Camera


class Pixels(NamedTuple):
    """The covered pixels: which face, where in it, and from which direction they are seen."""

    row: np.ndarray
    column: np.ndarray
    face: np.ndarray  # [N]
    corners: np.ndarray  # [N, 3] vertex indices
    barycentric: np.ndarray  # [N, 3]
    ray: np.ndarray  # [N, 3] direction in the studio; one of depth

    def take(self, at: np.ndarray) -> Pixels:
        return Pixels(*[np.take(values, at, axis=0) for values in self])

    def interpolate(self, values: np.ndarray, corners: np.ndarray | None = None) -> np.ndarray:
        """Per-vertex values [V, C] at the pixels [N, C]; other `corners` index other vertices, those of the chart say."""
        corners = self.corners if corners is None else corners
        out = np.take(values, corners[:, 0], axis=0) * self.barycentric[:, :1]
        out += np.take(values, corners[:, 1], axis=0) * self.barycentric[:, 1:2]
        out += np.take(values, corners[:, 2], axis=0) * self.barycentric[:, 2:]
        return out


def to_screen(points: np.ndarray, R_view: np.ndarray, t_view: np.ndarray, camera: Camera) -> np.ndarray:
    p = lighting.turn(points, R_view) + t_view
    depth = -p[:, 2]
    return np.stack((p[:, 0] / depth * camera.fx + camera.cx, -p[:, 1] / depth * camera.fy + camera.cy, depth), -1)


def covered(raster: MeshRaster, faces: np.ndarray, camera: Camera, R_view_studio: np.ndarray) -> Pixels:
    row, column = np.nonzero(raster.face_id >= 0)
    face = raster.face_id[row, column]
    ray = np.empty((len(row), 3), np.float32)
    ray[:, 0] = (column + 0.5 - camera.cx) / camera.fx
    ray[:, 1] = -(row + 0.5 - camera.cy) / camera.fy
    ray[:, 2] = -1.0
    ray = lighting.turn(ray, R_view_studio.T)
    return Pixels(row, column, face, faces[face], raster.barycentric[row, column], ray)
