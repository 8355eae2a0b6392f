"""The scale of a rig and the head's distance, of points that are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from avatar.errors import UserError
from data_prep.formats.frame_track import FrameTrack
from data_prep.track.camera_rig.place_head import Points, View, place_head, refuse_misfit

T, L = 5, 60
LENS = np.array([900.0, 910.0, 250.0, 240.0])
CENTRE = np.array([0.0, 0.0, 1.0])  # metres before the front camera
DEPTHS = np.array([0.03, -0.02, 0.0, 0.04, -0.05])  # by which the tracking is wrong
TURN = cv2.Rodrigues(np.array([0.06, -0.02, 0.01]))[0]  # by which it is wrong at all times
AZIMUTHS = {"front": 0.0, "left": -40.0, "right": 30.0, "far": 55.0}


def head() -> Points:
    """The front half of a ball that moves and turns."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(L, 3))
    normals[:, 2] = -np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turns = np.stack([cv2.Rodrigues(np.array([0.1 * n, 0.2 - 0.1 * n, 0.05]))[0] for n in range(T)])
    own = 0.09 * (normals - normals.mean(0))
    centres = CENTRE + 0.02 * rng.normal(size=(T, 3))
    return Points(np.tile(own, (T, 1, 1)), np.tile(normals, (T, 1, 1)), turns, centres)


def before_front(points: Points) -> np.ndarray:
    """[T, L, 3] in the front camera's axes."""
    return points.positions @ points.turns.transpose(0, 2, 1) + points.centres[:, None]


def filmed(points: Points, unit: float, names: tuple[str, ...] = tuple(AZIMUTHS)) -> dict[str, View]:
    """What cameras around the head find; the calibration counts in `unit` metres."""
    views = {}
    for name in names:
        R = cv2.Rodrigues(np.array([0.05, np.radians(AZIMUTHS[name]), 0.1]) * (name != "front"))[0]
        t = CENTRE - R @ CENTRE
        at = before_front(points) @ R.T + t
        views[name] = View(R, t / unit, LENS, LENS[:2] * at[..., :2] / at[..., 2:] + LENS[2:])
    return views


def tracked(points: Points, larger: float = 1.0, turn: np.ndarray = TURN) -> Points:
    """As one camera places them: at wrong depths, turned, and of the wrong size, which it cannot see."""
    way = points.centres / np.linalg.norm(points.centres, axis=1, keepdims=True)
    moved = larger * points.centres + DEPTHS[:, None] * way
    return Points(larger * points.positions, points.normals, points.turns @ turn, moved)


@pytest.mark.parametrize(("unit", "larger"), [(1.0, 1.0), (1e-6, 1.0), (1e4, 1.0), (1.07, 0.97)])
def test_scale_and_depths_come_back(unit: float, larger: float) -> None:
    truth = head()
    found = place_head(tracked(truth, larger), filmed(truth, unit))
    assert found.scale == pytest.approx(unit * larger, rel=1e-4)
    given = tracked(truth, larger)
    poses = {name: np.zeros(2) for name in ("expression", "jaw", "eyes", "eyelids", "neck", "shape", "intrinsics")}
    for row in range(T):
        track = FrameTrack(**poses, R=given.turns[row], t=given.centres[row], size=(1, 1))
        moved = found.moved(row, track, given.centres[row])
        assert np.allclose(moved.R, truth.turns[row], atol=1e-4)
        assert np.allclose(moved.t, larger * truth.centres[row], atol=1e-4)
    assert found.before > 5 and found.after < 0.05 and found.cameras == tuple(AZIMUTHS)


def test_a_time_without_faces_aside_and_wrong_landmarks_change_little() -> None:
    truth = head()
    views, rng = filmed(truth, 1.07), np.random.default_rng(1)
    for name in ("left", "right", "far"):
        views[name].found[2] = np.nan
    for view in views.values():
        view.found[:, ::10] += rng.normal(size=(T, L // 10, 2)) * 60
        view.found[...] += rng.normal(size=(T, L, 2)) * 0.5
    found = place_head(tracked(truth), views)
    assert found.scale == pytest.approx(1.07, rel=3e-3)
    assert np.abs(found.shifts[[0, 1, 3, 4], 2] + DEPTHS[[0, 1, 3, 4]]).max() < 4e-3


def test_a_camera_that_shows_another_face_is_left_out() -> None:
    truth = head()
    views = filmed(truth, 1.07)
    views["far"].found[...] += (80.0, -30.0)
    found = place_head(tracked(truth), views)
    assert found.cameras == ("front", "left", "right") and found.scale == pytest.approx(1.07, rel=1e-3)


def test_two_cameras_tell_the_scale_wherever_the_origin_lies() -> None:
    """Far from it, rounding moves the front camera."""
    truth = head()
    views = filmed(truth, 1.07, ("front", "left"))
    views["front"] = views["front"]._replace(t=np.array([3e-13, -2e-13, 1e-13]))
    assert place_head(tracked(truth), views).scale == pytest.approx(1.07, rel=1e-4)


def test_cameras_at_one_place_are_refused() -> None:
    truth = head()
    views = filmed(truth, 0.001, ("front",))
    views["beside"] = views["front"]._replace(t=np.array([5.0, 0.0, 0.0]))
    with pytest.raises(UserError, match="the cameras that see the face stand at one place"):
        place_head(tracked(truth), views)


def test_one_camera_with_a_face_is_too_few() -> None:
    views = filmed(head(), 1.0)
    for name in ("left", "right", "far"):
        views[name].found[...] = np.nan
    with pytest.raises(UserError, match="a face was found in 1 of 4 cameras; two at least are needed"):
        place_head(tracked(head()), views)


def test_cameras_that_look_away_are_refused() -> None:
    views = {name: view._replace(t=-view.t) for name, view in filmed(head(), 1.0).items()}
    with pytest.raises(UserError, match="by it, the cameras do not look at the face"):
        place_head(tracked(head()), views)


def test_a_calibration_of_other_cameras_is_refused() -> None:
    truth, turned = head(), cv2.Rodrigues(np.array([0.0, 0.12, 0.0]))[0]
    views = filmed(truth, 1.0)
    refuse_misfit(place_head(tracked(truth), views), views, Path("SPEECH"))
    views |= {name: views[name]._replace(R=turned @ views[name].R) for name in ("left", "far")}
    placed = place_head(tracked(truth), views)
    views["right"] = views["right"]._replace(found=50 * views["right"].found)  # one that sees the face much larger
    with pytest.raises(
        UserError, match="the calibration of SPEECH does not fit .* off by [0-9.]+ pixels in the median"
    ):
        refuse_misfit(placed, views, Path("SPEECH"))
