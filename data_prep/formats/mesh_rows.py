"""Which vertex of the head model each vertex of a mesh is.

A mesh of as many vertices as the model has keeps its order, whichever faces it leaves out: INSTA's `canonical.obj` has
FLAME's 5,023 vertices and 8,090 of its 9,766 faces. One of fewer vertices has lost those without faces, and keeps the order
of the others: the increasing rows of the least sum of distances to the model, which is then fitted, until neither changes.
The mesh's triangles have to be the model's.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.formats.mesh_fit import Mesh, fit_identity
from data_prep.formats.mesh_head import HeadRows

SHARED_TRIANGLES = 0.9  # at least; the rest may close an opening
FITTED = 2000  # vertices that are enough for an identity
_ROUNDS = 10


def spread(count: int, most: int) -> Int[np.ndarray, " N"]:
    """At most `most` of `count` indices, increasing, without a pattern; the same every time."""
    return np.sort(np.random.default_rng(0).permutation(count)[:most])


def match(head: HeadAssets, points: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " N"]:
    """Rows of the model's vertices. Raises UserError, which goes on after the file's name, where the mesh is another's."""
    N, V = len(points), head.num_vertices
    if N > V:
        raise UserError(
            f"has {N} vertices and the head model {V}; give --head the model that the meshes were made with"
        )
    rows = np.arange(V) if N == V else _fitted_rows(head, points)
    shared = float(np.isin(_codes(rows[faces], V), _codes(head.faces.numpy(), V)).mean()) if len(faces) else 1.0
    if shared < SHARED_TRIANGLES:
        raise UserError(
            f"has {N} vertices, and only {shared:.0%} of its triangles are the head model's; give --head the model that "
            "the meshes were made with"
        )
    return rows


def _fitted_rows(head: HeadAssets, points: np.ndarray) -> np.ndarray:
    everywhere, picked = HeadRows(head, np.arange(head.num_vertices)), spread(len(points), FITTED)
    rows = increasing_rows(points, everywhere.template)
    for _ in range(_ROUNDS):
        found, (pose,) = fit_identity(HeadRows(head, rows[picked]), [Mesh(points[picked])])
        before, fitted = rows, everywhere.with_identity(found.coefficients).vertices(pose)
        rows = increasing_rows(pose.inside(points), fitted)
        if (rows == before).all():
            break
    return rows


def increasing_rows(points: Float[np.ndarray, "N 3"], targets: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " N"]:
    """The increasing rows of `targets`, one for each point, of the least sum of distances, by dynamic programming.

    Point n can only be at one of the rows n ... n + V - N.
    """
    room = len(targets) - len(points) + 1
    is_least = np.empty((len(points), -(-room // 8)), np.uint8)  # bits: the least sum of the rows so far is reached
    least = np.zeros(room)
    for n, point in enumerate(points):
        sums = least + np.linalg.norm(targets[n : n + room] - point, axis=1)
        least = np.minimum.accumulate(sums)
        is_least[n] = np.packbits(sums == least)
    rows, last = np.empty(len(points), np.int64), room - 1
    for n in reversed(range(len(points))):
        last = int(np.flatnonzero(np.unpackbits(is_least[n])[: last + 1])[-1])
        rows[n] = n + last
    return rows


def _codes(faces: np.ndarray, count: int) -> np.ndarray:
    """One number for each triangle, whatever the order of its corners."""
    a, b, c = np.sort(faces, axis=1).T
    return (a * count + b) * count + c
