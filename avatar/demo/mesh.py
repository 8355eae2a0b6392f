"""The mesh of the demo head and its measures. scripts/make_demo_mesh.py sculpts it and writes head_mesh.npz.

Millimetres unless said otherwise, FLAME's axes: x to the subject's left, y up, z forward out of the face.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.files.pickles import load_npz

MESH_FILE = Path(__file__).with_name("head_mesh.npz")
EYE_CENTRE = np.array([31.5, 21.0, 64.0])  # left eye; the right one is its mirror image
EYE_RADIUS = 13.2
MOUTH_CENTRE = np.array([0.0, -47.5])  # frontal x, y
MOUTH_HALF_WIDTH = 25.0


class HeadMesh(NamedTuple):
    """The neutral head in metres; UV vertices have their own indices, as in an OBJ file."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int32 [F, 3], counter-clockwise from outside
    uvs: np.ndarray  # float64 [T, 2]
    uv_faces: np.ndarray  # int32 [F, 3]
    mirror: np.ndarray  # int64 [V], the vertex on the other side
    eye_rings: np.ndarray  # int64 [2, R, K] left and right, innermost first
    mouth_rings: np.ndarray  # int64 [2, R, K] left and right halves
    ear_rings: np.ndarray  # int64 [2, R, K]
    eyeballs: np.ndarray  # int64 [2, K] vertex indices, left and right
    rim: np.ndarray  # vertex indices of the neck's open end


def load_head_mesh() -> HeadMesh:
    """The mesh, the same bits on every machine."""
    return HeadMesh(**load_npz(MESH_FILE))


def lip_line(x: np.ndarray) -> np.ndarray:
    """Frontal y of the closed lips' contact line at frontal x."""
    return MOUTH_CENTRE[1] + 0.9 * (x / MOUTH_HALF_WIDTH) ** 2 - 0.7 * np.exp(-((x / 5.0) ** 2))


def smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Source: Quilez, "distance functions", https://iquilezles.org/articles/distfunctions."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * (k / 4.0)


def smooth_max(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    return -smooth_min(-a, -b, k)
