"""Cameras of a rig, out of how each sees the head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from some_tracks import track

from avatar.errors import UserError
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.root_pose import rotation_matrix
from data_prep.formats.tracked_folder import Shot
from data_prep.prepare.camera_rig import find_rig, heads_before

ASIDE, AWAY = rotation_matrix(np.array([0.0, 0.6, 0.0])), np.array([0.001, 0.0, 0.0])
HEADS = [track((0.0, 4.0 * time, 0.0), t=np.array([0.0, 0.01 * time, 0.8])) for time in range(4)]
SHOTS = [Shot(camera, time) for camera in ("left", "front") for time in range(4)]


def filmed(turn: float = 0.0, shift: float = 0.0) -> list[FrameTrack]:
    """By the camera aside, which at the last time stands otherwise by degrees and metres, and then by the front one."""
    aside = [replace(head, R=ASIDE @ head.R, t=ASIDE @ head.t + AWAY) for head in HEADS]
    Q, last = rotation_matrix(np.radians([0.0, turn, 0.0])), aside[-1]
    aside[-1] = replace(last, R=Q @ last.R, t=Q @ last.t + np.array([0.0, shift, 0.0]))
    return [*aside, *HEADS]


def test_the_most_frontal_camera_is_the_reference_and_others_stand_where_they_do() -> None:
    found = find_rig(SHOTS, filmed())
    front, left = found.rig.cameras
    assert (front.name, left.name) == ("front", "left") and found.rig.times == (0, 1, 2, 3) * 2
    np.testing.assert_allclose(np.reshape(left.R, (3, 3)), ASIDE, atol=1e-9)
    np.testing.assert_allclose(left.t, AWAY, atol=1e-9)
    for heads in (found.heads, heads_before(found.rig, filmed())[1]):
        for head, expected in zip(heads, HEADS, strict=True):
            np.testing.assert_allclose(head.R, expected.R, atol=1e-9)
            np.testing.assert_allclose(head.t, expected.t, atol=1e-9)


@pytest.mark.parametrize(
    ("turn", "shift", "moves"), [(0.5, 0.0, False), (0.0, 0.0018, False), (0.8, 0.0, True), (0.0, 0.0022, True)]
)
def test_a_camera_that_turns_or_shifts_is_refused(turn: float, shift: float, moves: bool) -> None:
    if moves:
        with pytest.raises(UserError, match="camera left moves against camera front, by up to"):
            find_rig(SHOTS, filmed(turn, shift))
    else:
        assert len(find_rig(SHOTS, filmed(turn, shift)).rig.cameras) == 2


def test_a_camera_is_placed_by_way_of_another_and_one_without_a_common_time_is_refused() -> None:
    tracks = filmed()
    shots, chosen = zip(*[(SHOTS[n], tracks[n]) for n in (0, 1, 2, 6, 7)], strict=True)  # left at 0-2, front at 2-3
    third = Shot("right", 0), replace(tracks[4], R=ASIDE.T @ tracks[4].R, t=ASIDE.T @ tracks[4].t)
    found = find_rig([*shots, third[0]], [*chosen, third[1]])
    np.testing.assert_allclose(np.reshape(found.rig.cameras[2].R, (3, 3)), ASIDE.T, atol=1e-9)
    np.testing.assert_allclose(found.heads[0].R, HEADS[0].R, atol=1e-9)
    with pytest.raises(UserError, match="camera right has no picture of a time that camera front has one of"):
        find_rig([*shots, Shot("right", 9)], [*chosen, third[1]])
