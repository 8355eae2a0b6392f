"""Vertices and triangles of a Wavefront OBJ, in the order of the file."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from avatar.errors import UserError
from avatar.files.read import read_bytes
from data_prep.formats.frame_track import BadFrame, vector

MAX_BYTES = 2**24  # FLAME's meshes have 0.5 MB
_LARGEST_HEAD = 10.0  # metres; millimetres are beyond


def read_vertices(path: Path) -> Float[np.ndarray, "N 3"]:
    """Metres. Raises UserError for a file that cannot be read, BadFrame for one that is no head of finite size."""
    return _vertices(_lines(path), path.name)


def read_mesh(path: Path) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "F 3"]]:
    """As `read_vertices`, with the triangles, none where the file has none."""
    lines = _lines(path)
    vertices = _vertices(lines, path.name)
    try:
        corners = [[int(corner.split(b"/")[0]) for corner in line.split()[1:]] for line in lines if line[:2] == b"f "]
        triangles = [(face[0], *pair) for face in corners for pair in pairwise(face[1:])]
        faces = np.array(triangles, np.int64).reshape(-1, 3) - 1
    except (ValueError, IndexError, OverflowError):
        raise BadFrame(f"{path.name} has a face that names no vertices") from None
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise BadFrame(f"a face of {path.name} names a vertex outside its {len(vertices)}")
    return vertices, faces


def _lines(path: Path) -> list[bytes]:
    try:
        return read_bytes(path, MAX_BYTES).splitlines()
    except UserError as error:
        raise BadFrame(str(error)) from None


def _vertices(lines: list[bytes], name: str) -> np.ndarray:
    found = [line for line in lines if line[:2] == b"v "]
    if not found:
        raise BadFrame(f"{name} holds no vertices")
    try:
        values = np.array(b" ".join(found).replace(b"v", b"").split(), np.float64).reshape(len(found), -1)[:, :3]
    except ValueError:
        raise BadFrame(f"{name} has a vertex that is not numbers") from None
    if values.shape[1] < 3:
        raise BadFrame(f"{name} has vertices of {values.shape[1]} numbers")
    points = vector(values, f"a vertex of {name}").reshape(-1, 3)
    if np.abs(points).max() > _LARGEST_HEAD:
        raise BadFrame(f"{name} reaches {np.abs(points).max():.3g} m from its origin, which no head in metres does")
    return points
