"""Mattes in which a network takes others for the person, against those of the frames of the most alike pose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from data_prep.track.mattes.alike_frames import ALIKE, APART, ClipFrame, clip_frame, person_alone, similarity

SIZE = 320


def person(at: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A head and shoulders, and landmarks of the face."""
    matte = np.zeros((SIZE, SIZE), np.uint8)
    x, y = at
    cv2.ellipse(matte, (x, y), (50, 65), 0, 0, 360, 255, -1)
    cv2.rectangle(matte, (x - 90, y + 85), (x + 90, SIZE), 255, -1)
    face = np.array([(-25.0, -15), (25, -15), (0, 10), (-15, 30), (15, 30), (0, 45)])
    return matte, face + at + 0.5


def places(count: int) -> list[tuple[int, int]]:
    return [(160 + round(12 * np.sin(i / 3)), 130 + round(5 * np.cos(i / 2))) for i in range(count)]


def clip(count: int) -> list[ClipFrame]:
    return [clip_frame(10 * n, *person(at)) for n, at in enumerate(places(count))]


def test_person_alone_leaves_out_passers_by_that_the_network_is_unsure_of() -> None:
    true, points = person((158, 131))
    seen = true.copy()
    seen[60:200, 270:310] = np.maximum(seen[60:200, 270:310], 140)
    seen[130:170, 10:50] = 200
    np.testing.assert_array_equal(person_alone(55, seen, points, clip(20)), true)


def test_person_alone_keeps_a_hand_that_the_network_is_sure_of_and_its_soft_edge() -> None:
    seen, points = person((158, 131))
    cv2.circle(seen, (40, 150), 22, 150, -1)
    cv2.circle(seen, (40, 150), 20, 255, -1)
    np.testing.assert_array_equal(person_alone(55, seen, points, clip(20)), seen)


def test_person_alone_keeps_a_lock_that_the_network_is_unsure_of() -> None:
    seen, points = person((163, 128))
    seen[57:63, 158:168] = 90  # above the head
    np.testing.assert_array_equal(person_alone(55, seen, points, clip(20)), seen)


def test_person_alone_keeps_more_in_an_unusual_pose() -> None:
    unsure = (slice(150, 190), slice(230, 260))
    for at, is_kept in (((160, 130), False), ((215, 130), True)):
        seen, points = person(at)
        seen[unsure] = 140
        assert (person_alone(55, seen, points, clip(20))[unsure] == 140).all() == is_kept


@pytest.mark.parametrize(("showing", "is_kept"), [(ALIKE // 2, False), (ALIKE // 2 + 1, True)])
def test_person_alone_keeps_what_most_frames_show(showing: int, is_kept: bool) -> None:
    true, points = person((160, 130))
    seen = true.copy()
    seen[20:60, 20:60] = 140
    frames = [clip_frame(10 * n, seen if n < showing else true, points) for n in range(ALIKE)]
    assert person_alone(200, seen, points, frames)[40, 40] == (140 if is_kept else 0)


def test_person_alone_leaves_a_matte_where_frames_are_too_few() -> None:
    seen, points = person((160, 130))
    seen[:40, :40] = 140
    frames = clip(ALIKE)
    assert person_alone(-APART, seen, points, frames)[20, 20] == 0
    assert person_alone(1 - APART, seen, points, frames) is seen  # frame 0 is too near
    assert person_alone(-APART, seen, points, frames[1:]) is seen
    assert person_alone(-APART, seen, points * np.nan, frames) is seen


def test_clip_frame_is_as_small_as_a_network_s_pictures() -> None:
    matte = np.zeros((500, 1000), np.uint8)
    matte[:, :500] = 255
    frame = clip_frame(3, matte, np.array([[500.0, 250.0]]))
    assert frame.matte.shape == (128, 256)
    np.testing.assert_allclose(frame.points, [[128, 64]])
    np.testing.assert_array_equal(frame.matte[:, 126:130], [[255, 255, 0, 0]] * 128)


@pytest.mark.parametrize("turn", [0.0, 0.4, -1.2])
def test_similarity_recovers_turn_scale_and_shift(turn: float) -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform(0, 256, (20, 2))
    M = 1.3 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    target = (source - 0.5) @ M.T + [7.0, -3.0] + 0.5
    np.testing.assert_allclose(similarity(source, target), np.column_stack((M, [7.0, -3.0])), atol=1e-9)
