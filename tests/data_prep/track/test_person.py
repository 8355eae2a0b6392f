"""One person is followed among several."""

from __future__ import annotations

import numpy as np

from data_prep.track.faces.detect import Face, overlap
from data_prep.track.faces.person import follow_one


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


def test_a_face_that_was_away_is_the_same_at_its_place() -> None:
    found = [[face(300)]] * 20 + [[]] * 30 + [[face(380)]] * 10
    chosen, notes = follow_one(found)
    assert places(chosen) == [300] * 20 + [None] * 30 + [380] * 10
    assert notes == ["the face comes back after a while (1x) and is taken as the same person's"]


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
