"""Flaws of a head model's mesh are found, each by its own sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from heads import grid_head

from avatar.head.assets import HeadAssets, load_head_assets
from data_prep.check.check_head import check_head
from data_prep.check.findings import Finding
from data_prep.check.folder import check_tracked_folder


def two_balls(turned: bool = False) -> HeadAssets:
    """Two spheres without their tops, the second one inside out if `turned`."""
    ball = trimesh.creation.icosphere(2, 0.1)
    faces = ball.faces[ball.triangles_center[:, 1] < 0.08]
    second = faces[:, ::-1] if turned else faces
    V = len(ball.vertices)
    points = torch.from_numpy(np.concatenate((ball.vertices, ball.vertices + np.array([0.3, 0, 0]))).astype(np.float32))
    both = torch.from_numpy(np.concatenate((faces, second + V)).astype(np.int64))
    return replace(grid_head(), template=points, faces=both, uvs=points[:, :2] + points[:, 2:], uv_faces=both)


def with_face(*corners: int) -> HeadAssets:
    """The grid with its face 5 made of other vertices, on the map as well."""
    head = grid_head()
    faces = head.faces.clone()
    faces[5] = torch.tensor(corners)
    return replace(head, faces=faces)


def squeezed() -> HeadAssets:
    head = grid_head()
    uv_faces = head.uv_faces.clone()
    uv_faces[7, 1] = uv_faces[7, 0]
    return replace(head, uv_faces=uv_faces)


def turned_face() -> HeadAssets:
    head = grid_head()
    faces = head.faces.clone()
    faces[20] = faces[20].flip(0)
    return replace(head, faces=faces)


def branched() -> HeadAssets:
    """A third face on the edge between vertices 10 and 18."""
    head = grid_head()
    more = torch.cat((head.faces, torch.tensor([[18, 10, 40]])))
    return replace(head, faces=more, uv_faces=torch.cat((head.uv_faces, torch.tensor([[18, 10, 40]]))))


FLAWS: dict[str, tuple[Callable[[], HeadAssets], str, str]] = {
    "a face of one vertex twice": (
        lambda: with_face(5, 5, 14), "note",
        "1 of 96 faces of the head model have no area on the head, the first is face 5 of the vertices 5, 5, 14",
    ),
    "a face that is a line on the map": (
        squeezed, "note", "1 of 96 faces of the head model have no area in the UV layout, the first is face 7"
    ),
    "a face that is turned round": (turned_face, "warning", "not all wound the same way: at 3 edges two neighbours face"),
    "a surface that branches": (branched, "note", "1 edges of the head model belong to three faces or more, the first "
                                "joins 10 and 18"),
    "a piece that is inside out": (lambda: two_balls(True), "warning", "look inwards"),
}  # fmt: skip


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("flaw", FLAWS)
def test_a_flaw_is_found(flaw: str) -> None:
    make, severity, sentence = FLAWS[flaw]
    found = [finding for finding in check_head(make()) if sentence in finding.problem]
    assert len(found) == 1 and found[0].severity == severity and found[0].check == "head-mesh"


@pytest.mark.usefixtures("any_shapes")
def test_only_the_piece_that_is_inside_out_is_named() -> None:
    half = len(two_balls().faces) // 2
    (finding,) = check_head(two_balls(turned=True))
    assert finding.problem == f"{half} faces of the head model, among them face {half}, look inwards"


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("make", [grid_head, two_balls])
def test_good_meshes_have_no_findings(make: Callable[[], HeadAssets]) -> None:
    assert check_head(make()) == []


def test_a_folder_is_checked_with_its_head(tracked_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flaw = Finding("note", "head-mesh", "a flaw", "nothing")
    monkeypatch.setattr("data_prep.check.folder.check_head", lambda _: [flaw])
    head = tracked_folder / "head_model"
    assert flaw in check_tracked_folder(tracked_folder, lambda: load_head_assets(head), frame_offset=1).findings


@pytest.mark.shared
def test_the_development_head_has_no_findings(shared_dir: Path) -> None:
    assert check_head(load_head_assets(shared_dir / "subjects" / "head_model")) == []
