"""What is set on a page's face while it moves: that alone changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from browsers import node


@pytest.fixture(scope="module")
def faces() -> dict[str, Any]:
    return node(Path(__file__).parent / "settings.mjs")


def changed(faces: dict[str, Any], name: str) -> dict[str, Any]:
    return {part: value for part, value in faces[name].items() if value != pytest.approx(faces["nothing"][part])}


def test_rotation_vectors_are_those_of_the_motion(faces: dict[str, Any]) -> None:
    assert faces["nothing"]["left"] == pytest.approx([0.1, -0.3, 0.02], abs=1e-6)
    assert faces["nothing"]["jaw"] == pytest.approx([0.2, 0, 0], abs=1e-6)


def test_a_control_moves_the_expression_along_its_direction_only(faces: dict[str, Any]) -> None:
    """The face is at 1.1 of `wide` and at 0.2 of `up`, and 0.5 off both, from the rest (0.5, -1, 2)."""
    assert changed(faces, "wide") == {"expression": pytest.approx([1 - 1.1 * 0.6, -1.1 * 0.8, 1.5], abs=1e-6)}
    assert changed(faces, "both") == {
        "expression": pytest.approx([0.5 + 2 * 0.6 + 0.8, -1 + 2 * 0.8 - 0.6, 1.5], abs=1e-6)
    }


def test_of_a_control_and_a_coefficient_the_last_wins(faces: dict[str, Any]) -> None:
    assert faces["controlLast"]["expression"] == pytest.approx([0.5 + 2 * 0.6, -1 + 2 * 0.8, 2], abs=1e-6)
    wide = 2 - 1.1  # from where the face is
    assert faces["coefficientLast"]["expression"] == pytest.approx([4, wide * 0.8, 7], abs=1e-6)


def test_one_number_of_a_gaze_leaves_the_others_to_the_motion(faces: dict[str, Any]) -> None:
    moved = changed(faces, "gaze")
    assert moved == {side: pytest.approx([0.1, 0.2, 0], abs=1e-6) for side in ("left", "right")}
    assert changed(faces, "lid") == {"lids": pytest.approx([0.5, 0.3], abs=1e-6)}
    assert changed(faces, "released") == {}


def test_what_is_no_pose_is_refused(faces: dict[str, Any]) -> None:
    assert faces["refused"] == ["jaw of a pose is 3 numbers.", "lids of a pose is 2 numbers.", "fine"]
