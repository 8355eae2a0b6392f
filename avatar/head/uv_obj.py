"""The UV layout of a head model, from an OBJ of the same topology.

OBJ libraries split vertices at UV seams and drop the original indices, which are what ties the layout to the model's
faces; so the three kinds of line that matter are read here.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.files.read import read_bytes

MAX_BYTES, MAX_LINE = 2**25, 10_000  # FLAME's template has 1.5 MB


def read_uv_obj(file: Path, faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """UVs float32 [T, 2] and, for every row of `faces` [F, 3] in its order, the UV rows of its corners int64 [F, 3].

    Raises UserError when the OBJ has no UVs or another topology than the model.
    """
    lines = io.BytesIO(read_bytes(file, MAX_BYTES))
    uvs: list[tuple[float, float]] = []
    corners: list[list[tuple[int, int]]] = []
    positions = 0
    number = 0
    try:
        for number, line in enumerate(lines, start=1):  # noqa: B007 (the message names the line)
            if len(line) > MAX_LINE:
                raise ValueError("no line is so long")
            kind, _, rest = line.decode(errors="replace").strip().replace("\t", " ").partition(" ")
            if kind == "v":
                positions += 1
            elif kind == "vt":
                u, v = rest.split()[:2]
                uvs.append((float(u), float(v)))
            elif kind == "f":
                pairs = [corner.split("/")[:2] for corner in rest.split()]
                polygon = [(_place(int(v), positions), _place(int(vt), len(uvs))) for v, vt in pairs]
                corners += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    except ValueError:
        raise UserError(
            f"{file}, line {number}: not a line of an OBJ file whose faces carry UVs (f v/vt ...)"
        ) from None

    if positions != num_vertices or len(corners) != len(faces):
        raise UserError(
            f"{file} has {positions} vertices and {len(corners)} triangles, but the head model has {num_vertices} and "
            f"{len(faces)}; the UV layout must be of the same topology"
        )
    try:
        layout = np.asarray(corners, dtype=np.int64).reshape(-1, 3, 2)
    except OverflowError:
        raise UserError(f"{file}: a face names a vertex or a UV by a number that no file can have") from None
    with np.errstate(over="ignore"):  # what float32 cannot hold is found to be not finite below
        uv_array = np.asarray(uvs, dtype=np.float64).reshape(-1, 2).astype(np.float32)
    if not np.isfinite(uv_array).all() or layout[..., 1].min() < 0 or layout[..., 1].max() >= len(uv_array):
        raise UserError(f"{file}: a face names a UV outside the {len(uv_array)} vt lines, or a vt line is not finite")
    return uv_array, _in_order_of(faces, layout, file)


def _place(number: int, count: int) -> int:
    """0-based, from a number in a face: from 1 on, or back from the last of the `count` so far, which is -1."""
    return count + number if -count <= number < 0 else number - 1


def _in_order_of(faces: np.ndarray, layout: np.ndarray, file: Path) -> np.ndarray:
    """The UV corners of `layout` [F, 3, (vertex, uv)] for each row of `faces`, whatever the order in the file."""
    if np.array_equal(layout[..., 0], faces):
        return np.ascontiguousarray(layout[..., 1])
    by_vertices: dict[tuple[int, ...], dict[int, int]] = {
        tuple(sorted(face[:, 0].tolist())): {int(v): int(uv) for v, uv in face} for face in layout
    }
    try:
        rows = [[by_vertices[tuple(sorted(face))][v] for v in face] for face in faces.tolist()]
    except KeyError as error:
        raise UserError(
            f"{file} has no triangle with the vertices {error.args[0]} of the head model; the UV layout must be of the "
            "same topology"
        ) from None
    return np.asarray(rows, dtype=np.int64)
