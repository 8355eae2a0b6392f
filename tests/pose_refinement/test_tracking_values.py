"""Tracking as vectors: the way there and back, turning about the head's centre, how things accelerate."""

from __future__ import annotations

import math

import pytest
import torch
from drawn_clip import EXPRESSIONS, true_tracks

from avatar.head.model import matrix_from_6d
from avatar.pose_refinement.tracking_values import (
    EXPRESSION,
    EYES,
    JAW,
    NECK,
    SHIFT,
    TURN,
    HeadPose,
    accelerations,
    head_params,
    moved_pose,
    moved_tracks,
    rotation,
    values_of,
)

CENTRE = torch.tensor([0.01, 0.05, -0.02])


def test_vectors_hold_what_the_tracks_hold() -> None:
    tracks = true_tracks(5)
    values = values_of(tracks)
    assert values.shape == (5, 20 + EXPRESSIONS) and not values[:, :6].any()
    params = head_params(values[3])
    assert torch.equal(params.expression, tracks["expression"][3]) and torch.equal(params.eyelids, tracks["eyelids"][3])
    for name in ("neck", "jaw", "eyes"):
        assert torch.allclose(getattr(params, name), tracks[name][3], atol=1e-6)


def test_left_and_right_eye_keep_their_places() -> None:
    values = torch.zeros(20 + EXPRESSIONS)
    values[EYES] = torch.tensor([0.2, 0.0, 0.0, 0.0, -0.3, 0.0])
    left, right = matrix_from_6d(head_params(values).eyes.reshape(2, 6))
    assert left[2, 1] == pytest.approx(math.sin(0.2)) and right[0, 2] == pytest.approx(-math.sin(0.3))


def test_rotation_is_smooth_at_zero() -> None:
    vectors = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.equal(rotation(vectors)[0], torch.eye(3, dtype=torch.float64))
    assert torch.autograd.gradcheck(rotation, vectors)


def test_the_head_turns_about_its_centre_and_shifts_along_the_camera() -> None:
    tracks = true_tracks(3)
    given = HeadPose(tracks["R"][1], tracks["t"][1])
    values = torch.zeros(20 + EXPRESSIONS)
    values[TURN], values[SHIFT] = torch.tensor([0.0, 0.0, 0.1]), torch.tensor([0.002, 0.0, -0.004])
    moved = moved_pose(values, given, CENTRE)
    before, after = (pose.R @ CENTRE + pose.t for pose in (given, moved))
    assert torch.allclose(after - before, values[SHIFT], atol=1e-7)
    # a turn about the line of sight: a point to the head's side goes round clockwise on a screen whose y points down
    side = given.R @ (CENTRE + given.R.T @ torch.tensor([1.0, 0, 0])) + given.t - before
    turned = moved.R @ (CENTRE + given.R.T @ torch.tensor([1.0, 0, 0])) + moved.t - after
    assert torch.allclose(side, torch.tensor([1.0, 0, 0]), atol=1e-6)
    assert torch.allclose(turned, torch.tensor([math.cos(0.1), math.sin(0.1), 0]), atol=1e-6)


def test_unchanged_parts_keep_their_bits_and_changed_ones_come_back() -> None:
    tracks = true_tracks(6)
    values = values_of(tracks)
    changed = torch.zeros(values.shape[1], dtype=torch.bool)
    changed[JAW] = True
    values[:, JAW] += 0.01
    values[:, EXPRESSION] += 1.0  # not said to have changed
    moved = moved_tracks(tracks, values, changed, CENTRE)
    for name in ("expression", "eyes", "eyelids", "neck", "shape"):
        assert torch.equal(moved[name], tracks[name])
    assert torch.allclose(moved["R"], tracks["R"], atol=1e-7) and torch.allclose(moved["t"], tracks["t"], atol=1e-7)
    assert torch.allclose(values_of(moved)[:, JAW], values[:, JAW], atol=1e-6)
    assert not torch.allclose(moved["jaw"], tracks["jaw"], atol=1e-3)


def test_accelerations_are_second_differences_of_motion_in_the_cameras_axes() -> None:
    tracks = true_tracks(8)
    angle = torch.arange(8.0) ** 2 * 0.01
    turns = torch.zeros(8, 3)
    turns[:, 1] = angle
    tracks["R"] = rotation(turns) @ tracks["R"][:1]
    tracks["t"] = torch.zeros(8, 3)
    tracks["t"][:, 2] = 0.8 + 0.003 * torch.arange(8.0) ** 2
    values = values_of(tracks)
    found = accelerations(tracks, values, torch.zeros(3))
    assert torch.allclose(found[1:-1, 1], torch.full((6,), 0.02, dtype=torch.float64), atol=1e-6)
    assert torch.allclose(found[1:-1, 5], torch.full((6,), 0.006, dtype=torch.float64), atol=1e-6)
    assert not found[[0, -1]].any() and float(found[:, [0, 2, 3, 4]].abs().max()) < 1e-6
    expected = values[2:] - 2 * values[1:-1] + values[:-2]
    assert torch.allclose(found[1:-1, EXPRESSION].float(), expected[:, EXPRESSION], atol=1e-6)
    assert not found[:, NECK].any()
    assert accelerations({n: v[:2] for n, v in tracks.items()}, values[:2], torch.zeros(3)).shape == values[:2].shape
