"""Poses that a fit starts from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.errors import UserError
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.initial_pose import start_poses

CAMERA = Pinhole(1500.0, 1500.0, 960.0, 540.0)
POINTS = np.random.default_rng(0).normal(0.0, 0.05, (40, 3))


def seen_at(metres: float) -> np.ndarray:
    places = POINTS * [1.0, -1.0, -1.0] + [0.0, 0.0, metres]
    return places[:, :2] / places[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]


def test_a_face_that_is_too_small_for_the_lens_takes_the_pose_of_another_frame() -> None:
    near, far = seen_at(0.8), seen_at(400.0)
    R, t = start_poses(POINTS, np.stack((far, near, far, seen_at(1.0))), CAMERA)
    assert t[:, 2].tolist() == pytest.approx([0.8, 0.8, 0.8, 1.0], abs=1e-4)
    torch.testing.assert_close(
        R, torch.diag(torch.tensor([1.0, -1.0, -1.0])).double().expand(4, 3, 3), atol=1e-5, rtol=0
    )


def test_a_lens_through_which_no_frame_shows_a_head_is_refused() -> None:
    with pytest.raises(UserError, match="--fov or --focal"):
        start_poses(POINTS, seen_at(400.0)[None], CAMERA)
