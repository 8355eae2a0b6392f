"""Findings about the head model's mesh: what training and drawing take for granted of a surface."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from avatar.head.assets import HeadAssets
from data_prep.check.findings import Finding

if TYPE_CHECKING:
    from trimesh import Trimesh

# Of its box; the head with its open neck fills half of its own. A bent sheet fills little, and has no inside.
_INSIDE_OUT = -0.25
_CHECK = "head-mesh"


def check_head(assets: HeadAssets) -> list[Finding]:
    from trimesh import Trimesh  # a third of a second that other commands save

    mesh = Trimesh(assets.template.numpy(), assets.faces.numpy(), process=False)
    flat_uvs = np.pad(assets.uvs.numpy(), ((0, 0), (0, 1)))
    layout = Trimesh(flat_uvs, assets.uv_faces.numpy(), process=False)
    no_area = ~mesh.nondegenerate_faces()
    return [
        *(Finding("note", "head-model", note, "nothing, if that is meant") for note in assets.notes),
        *_faces(no_area, assets, "no area on the head", "no Gaussian on them has a direction to face"),
        *_faces(
            ~layout.nondegenerate_faces() & ~no_area, assets, "no area in the UV layout", "no Gaussian lies on them"
        ),
        *_edges(mesh),
        *_inside_out(mesh),
    ]


def _faces(bad: np.ndarray, assets: HeadAssets, what: str, consequence: str) -> Iterator[Finding]:
    if not bad.any():
        return
    first = int(bad.argmax())
    problem = (
        f"{bad.sum()} of {len(bad)} faces of the head model have {what}, the first is face {first} of the vertices "
        f"{', '.join(map(str, assets.faces[first].tolist()))}"
    )
    yield Finding("note", _CHECK, problem, f"nothing, if that is meant: {consequence}")


def _edges(mesh: Trimesh) -> Iterator[Finding]:
    shared = np.bincount(mesh.edges_unique_inverse) > 2
    if shared.any():
        a, b = mesh.edges_unique[shared][0]
        problem = f"{shared.sum()} edges of the head model belong to three faces or more, the first joins {a} and {b}"
        yield Finding("note", _CHECK, problem, "nothing, if that is meant: the surface branches there")
    if not mesh.is_winding_consistent:
        runs, times = np.unique(mesh.edges, axis=0, return_counts=True)
        (a, b), count = runs[times > 1][0], (times > 1).sum()
        problem = (
            f"the faces of the head model are not all wound the same way: at {count} edges two neighbours face opposite "
            f"sides, the first is the one from vertex {a} to {b}"
        )
        yield Finding("warning", _CHECK, problem, "turn the vertices of these faces round in the model file")


def _inside_out(mesh: Trimesh) -> Iterator[Finding]:
    """Pieces of the surface whose faces look inwards: they get no first colours and are not drawn over the images."""
    from trimesh.graph import connected_components

    for piece in connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces))):
        corners = mesh.triangles[piece]
        corners = corners - corners.mean(axis=(0, 1))
        box = np.ptp(corners.reshape(-1, 3), axis=0).prod()
        if np.linalg.det(corners).sum() / 6 < _INSIDE_OUT * box:
            problem = f"{len(piece)} faces of the head model, among them face {min(piece)}, look inwards"
            advice = "turn their vertices round in the model file: counter-clockwise seen from outside"
            yield Finding("warning", _CHECK, problem, advice)
