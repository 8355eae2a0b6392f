"""How far the camera may be turned about a head."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import rest_params

from avatar.motion.orbit import orbit_limits, orbited, seen_from
from avatar.types import Camera

PARAMS = rest_params()
FRONT = Camera(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.8]), 80, 80, 32, 30, 64, 64)


def test_a_turned_head_is_seen_from_its_other_side() -> None:
    assert seen_from(FRONT) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert seen_from(orbited(FRONT, yaw=20.0)) == pytest.approx((-20.0, 0.0), abs=1e-4)
    assert seen_from(orbited(FRONT, pitch=10.0)) == pytest.approx((0.0, 10.0), abs=1e-4)


def test_limits_are_the_turns_that_training_has_shown() -> None:
    """Of a video that shows much more of one side, and more from above."""
    training = [orbited(FRONT, yaw, pitch) for yaw in (-5.0, 0.0, 12.0, 30.0) for pitch in (-2.0, 6.0)]
    seen = [seen_from(camera) for camera in training]
    limits = orbit_limits(FRONT, training)
    ends = [seen_from(orbited(FRONT, yaw=turn)).yaw for turn in limits.yaw]
    assert sorted(ends) == pytest.approx([min(seen).yaw, max(seen).yaw], abs=2.0)
    heights = [seen_from(orbited(FRONT, pitch=turn)).elevation for turn in limits.pitch]
    elevations = [angles.elevation for angles in seen]
    assert heights == pytest.approx([min(elevations), max(elevations)], abs=1.0)
    assert orbit_limits(FRONT, training[-2:]).yaw[0] == 0.0  # the camera at rest is always within


def test_zoom_is_about_the_middle_of_the_picture() -> None:
    near = orbited(replace(FRONT, cx=40), zoom=2.0)
    assert (near.fx, near.fy, near.cx, near.cy) == (160, 160, 48, 28)


def test_a_camera_of_a_rig_moves_around_a_head_that_stays() -> None:
    side = orbited(replace(FRONT, R_ref_cam=orbited(FRONT, 40.0, 5.0).R_cam_world), 10.0)
    moved = orbited(side, yaw=20.0, pitch=-10.0)
    torch.testing.assert_close(moved.head_rotation, side.head_rotation, rtol=0, atol=1e-6)
    assert seen_from(moved).yaw == pytest.approx(-30.0, abs=1.0)
