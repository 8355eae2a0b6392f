"""One person is followed among several."""

from __future__ import annotations

import numpy as np

from data_prep.track.faces.detect import Face, overlap
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.faces.person import follow_one
from data_prep.track.first_pass import FirstPass
from data_prep.track.track import _left_out


def face(x: float, size: float = 100.0) -> Face:
    """A square face around (x, 200)."""
    points = np.zeros((478, 3), np.float32)
    points[:, 0], points[:, 1] = x, 200
    points[:4, :2] += np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2
    return Face(points, np.full(52, x, np.float32))


def places(chosen: list[Face | None]) -> list[float | None]:
    return [None if face is None else float(face.scores[0]) for face in chosen]


def test_the_largest_is_followed_also_where_the_order_changes() -> None:
    found = [[face(300 + n, 100), face(600, 60)] if n % 2 else [face(600, 60), face(300 + n, 100)] for n in range(20)]
    chosen, notes = follow_one(found)
    assert places(chosen) == [300 + n for n in range(20)]
    assert notes == ["another face is beside it in 20 of 20 pictures: the largest one is followed"]


def test_another_person_never_stands_in() -> None:
    found = [[face(300)]] * 20 + [[]] * 5 + [[face(900, 100)]] * 8
    chosen, notes = follow_one(found)
    assert places(chosen) == [300] * 20 + [None] * 13
    assert notes == ["the face changes: 8 of 33 pictures, from number 25 on, show another person's only; left out"]


def test_a_picture_of_another_person_is_not_said_to_show_no_face() -> None:
    points, scores = np.zeros((3, NUM_POINTS, 3), np.float32), np.zeros((3, len(BLENDSHAPES)), np.float32)
    landmarks = Landmarks(points, scores, np.array([True, False, False]), (64, 64), 25.0)
    reasons = _left_out(FirstPass(landmarks, np.array([0, 1, -1]), 2, True, []))
    assert "the person's face was not found" in reasons[1] and "no picture" in reasons[2]


def test_a_face_that_was_away_is_the_same_at_its_place() -> None:
    found = [[face(300)]] * 20 + [[]] * 30 + [[face(380)]] * 10
    chosen, notes = follow_one(found)
    assert places(chosen) == [300] * 20 + [None] * 30 + [380] * 10
    (note,) = notes
    assert "comes back" in note and "1x" in note


def test_a_face_that_moves_far_between_two_pictures_is_not_said_to_have_been_away() -> None:
    chosen, notes = follow_one([[face(300)]] * 20 + [[face(420)]] * 20)
    assert places(chosen) == [300] * 20 + [420] * 20
    (note,) = notes
    assert "moves far" in note and "1x" in note


def test_a_face_of_another_size_is_not() -> None:
    found = [[face(300)]] * 20 + [[]] * 30 + [[face(300, 40)]] * 10
    assert places(follow_one(found)[0]) == [300] * 20 + [None] * 40


def test_short_losses_are_nothing() -> None:
    found = [[face(300 + 3 * n)] if n % 5 else [] for n in range(40)]
    chosen, notes = follow_one(found)
    assert places(chosen) == [300 + 3 * n if n % 5 else None for n in range(40)] and notes == []


def test_no_face_at_all() -> None:
    assert follow_one([[], []]) == ([None, None], [])


def test_overlap_of_boxes() -> None:
    assert overlap((0, 0, 2, 2), (0, 0, 2, 2)) == 1.0
    assert overlap((0, 0, 2, 2), (1, 0, 3, 2)) == 1 / 3
    assert overlap((0, 0, 2, 2), (2, 0, 3, 2)) == 0.0
