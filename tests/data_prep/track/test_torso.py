"""The torso beneath a tracked head, from drawn shirts whose place is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from avatar.types import IDENTITY_6D
from data_prep.formats.frame_track import FrameTrack
from data_prep.track.torso import SIDE, Neck, Picture, TorsoTracker, with_torso

SIZE = 2 * SIDE  # of the frames: twice that of the pictures that are aligned
FOCAL = 1200.0
NECK = Neck(np.array([0.0, -0.01, -0.05]), np.array([0.0, -0.15, -0.01]))
UPRIGHT = np.diag([1.0, -1.0, -1.0])
SHIRT = np.array([[-200, 45], [-60, 0], [-35, 22], [0, 30], [35, 22], [60, 0], [200, 45], [210, 400], [-210, 400]])
TEXTURE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (2 * SIZE, 2 * SIZE), np.uint8), (0, 0), 5)


def track(turn: tuple[float, float, float] = (0, 0, 0), x: float = 0.0, depth: float = 1.0) -> FrameTrack:
    values = {"expression": 2, "jaw": 6, "eyes": 12, "eyelids": 2, "shape": 2}
    R = UPRIGHT @ cv2.Rodrigues(np.array(turn, np.float64))[0]
    made = {name: np.zeros(count) for name, count in values.items()}
    t = np.array([x, 0.02, depth])
    K = np.array([FOCAL, FOCAL, SIZE / 2, SIZE / 2])
    return FrameTrack(**made, neck=np.array(IDENTITY_6D), R=R, t=t, intrinsics=K, size=(SIZE, SIZE))


def base(of: FrameTrack, orientation: np.ndarray = UPRIGHT) -> np.ndarray:
    """Where a torso of that orientation has the base of its neck: pixels of the frame."""
    point = of.R @ NECK.joint + of.t + orientation @ NECK.arm
    return of.intrinsics[:2] * point[:2] / point[2] + of.intrinsics[2:]


def filmed(at: np.ndarray, size: float = 1.0, hand: bool = False) -> Picture:
    """A shirt whose collar has its middle at `at`; a head above it."""
    placed = np.rint(16 * (size * SHIRT + at - 0.5)).astype(np.int32)
    shirt = cv2.fillPoly(np.zeros((SIZE, SIZE), np.uint8), [placed], 255, cv2.LINE_AA, 4)
    warp = np.array([[size, 0, at[0] - size * SIZE], [0, size, at[1] - size * SIZE]])
    grey = cv2.warpAffine(TEXTURE, warp, (SIZE, SIZE)) // 2
    head = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(head, (int(at[0]), int(at[1] - 100 * size)), int(90 * size), 255, cv2.FILLED)
    if hand:
        cv2.circle(grey, (int(at[0]), int(at[1] + 60)), 120, 255, cv2.FILLED)
        cv2.circle(shirt, (int(at[0]), int(at[1] - 20)), 110, 255, cv2.FILLED)
    return Picture(np.repeat(grey[..., None], 3, axis=2), np.maximum(shirt, head), head)


def tracker(tracks: list[FrameTrack], pictures: list[Picture]) -> TorsoTracker:
    return TorsoTracker(dict(enumerate(tracks)), NECK, pictures.__getitem__)


STILL = track()


@pytest.mark.parametrize("beside", [(0.0, 0.0), (9.0, 0.0), (-6.0, 3.0)])
def test_a_shirt_that_stays_behind_is_found(beside: tuple[float, float]) -> None:
    """The head moves aside; the shirt follows but for `beside` pixels of the frame."""
    moved = track(x=0.03)
    own = tracker([STILL, STILL, moved], [filmed(base(STILL))] * 2 + [filmed(base(moved) + beside)])
    found = own.shift(2)
    assert found is not None
    np.testing.assert_allclose(found, np.array(beside) * SIDE / SIZE, rtol=0, atol=0.25)


def test_size_that_the_heads_depth_explains_is_no_motion() -> None:
    far = track(depth=1.25)
    own = tracker([STILL, STILL, far], [filmed(base(STILL))] * 2 + [filmed(base(far), 1 / 1.25)])
    found = own.shift(2)
    assert found is not None and np.abs(found).max() < 0.3


def test_the_torso_turns_until_the_base_lies_on_the_collar() -> None:
    moved = track(turn=(0.1, 0.3, 0.05), x=0.02)
    tracks = [STILL, STILL, STILL, STILL, moved]
    own = tracker(tracks, [filmed(base(STILL))] * 5)
    shift = np.array([3.0, 0.0])  # a turn hardly moves the base up or down
    R = own.turn(4, shift)
    np.testing.assert_allclose(base(moved, R) - base(moved, own.mean), shift * SIZE / SIDE, rtol=0, atol=0.3)
    found = with_torso(dict(enumerate(tracks)), own, [np.zeros(2)] * 2 + [shift] * 3)
    rows = found[4].neck.reshape(2, 3)
    neck = np.stack((*rows, np.cross(*rows)))
    np.testing.assert_allclose(moved.R @ neck.T, R, rtol=0, atol=1e-9)  # the torso: the head, turned back by the neck
    assert (found[4].R == moved.R).all() and (found[4].t == moved.t).all()


def test_frames_behind_a_hand_take_their_neighbours_place() -> None:
    tracks = [STILL] * 11
    pictures = [filmed(base(STILL)) for _ in range(11)]
    pictures[5] = filmed(base(STILL), hand=True)
    own = tracker(tracks, pictures)
    assert own.reference != 5 and own.shift(5) is None and own.shift(4) is not None
    shifts = [np.array([0.5 * n, 0.0]) for n in range(11)]
    known = with_torso(dict(enumerate(tracks)), own, shifts)
    filled = with_torso(dict(enumerate(tracks)), own, [None if n == 5 else s for n, s in enumerate(shifts)])
    np.testing.assert_allclose(filled[5].neck, known[5].neck, rtol=0, atol=1e-9)


def test_without_any_clothes_nothing_is_followed() -> None:
    bare = filmed(base(STILL))
    own = tracker([STILL] * 3, [bare._replace(matte=bare.head)] * 3)
    assert not own.has_clothes and own.shift(1) is None
    tracks = dict(enumerate([STILL, replace(STILL, t=np.ones(3))]))
    assert with_torso(tracks, own, [None, None]) is tracks
