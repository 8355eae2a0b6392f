from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from camera_rig_folder import opened, write_single
from heads import random_params, rest_params

from avatar.head.model import matrix_from_6d
from avatar.motion.drive import Drive, choose_cameras, smoothed, subject_drive
from avatar.motion.training_distance import FAR, GRID, DistanceStrip, distances_csv
from avatar.types import Camera


def camera(focal: float, depth: float, size: int = 100, centre: float = 50.0) -> Camera:
    return Camera(torch.eye(3), torch.tensor([0.02, -0.01, depth]), focal, focal, centre, centre, size, size)


def drive(frames: int, **changes: object) -> Drive:
    params = [random_params(seed) for seed in range(frames)]
    cameras = [camera(200.0, 1.0 + 0.01 * i) for i in range(frames)]
    names = tuple(f"{i:05d}" for i in range(frames))
    return replace(Drive("d", 25.0, names, params, cameras, torch.zeros(0)), **changes)  # type: ignore[arg-type]


def test_no_smoothing_changes_nothing_and_some_keeps_what_is_constant_or_linear() -> None:
    moving = drive(40)
    assert smoothed(moving, 0.0) is moving
    still = replace(moving, params=[random_params(3)] * 40)
    out = smoothed(still, 2.0)
    assert out.cameras is not None
    for params in out.params:
        torch.testing.assert_close(params.expression, random_params(3).expression)
        expected = matrix_from_6d(random_params(3).jaw)[:2].reshape(6)
        torch.testing.assert_close(params.jaw, expected, rtol=0, atol=1e-5)
    depths = torch.stack([c.t_cam_world[2] for c in out.cameras])[6:-6]
    torch.testing.assert_close(depths, 1.0 + 0.01 * torch.arange(6, 34), rtol=0, atol=1e-5)


def test_smoothing_is_a_centred_gaussian_and_leaves_gaze_and_blinks() -> None:
    frames = 21
    peak = [rest_params() for _ in range(frames)]
    peak[10] = replace(peak[10], expression=torch.ones(5), eyelids=torch.ones(2))
    out = smoothed(drive(frames, params=peak), 1.5)
    values = torch.stack([p.expression[0] for p in out.params])
    assert int(values.argmax()) == 10
    torch.testing.assert_close(values, values.flip(0))
    assert float(values.sum()) == pytest.approx(1.0, abs=1e-5)
    ratio = torch.exp(torch.tensor(-0.5 / 1.5**2))
    assert float(values[9] / values[10]) == pytest.approx(float(ratio), abs=1e-5)
    assert [float(p.eyelids[0]) for p in out.params] == [float(p.eyelids[0]) for p in peak]
    assert all(torch.equal(a.eyes, b.eyes) for a, b in zip(out.params, peak, strict=True))


@pytest.mark.parametrize("joint", ["jaw", "neck"])
def test_smoothing_calms_a_joint_that_trembles(joint: str) -> None:
    """As VHAP's neck does, which holds a part of the head's motion."""
    nod = [torch.tensor([1.0, 0, 0, 0, math.cos(a), -math.sin(a)]) for a in (0.05 * (-1) ** n for n in range(20))]
    trembling = drive(20, params=[replace(rest_params(), **{joint: rows}) for rows in nod])
    cameras = smoothed(replace(trembling, cameras=[camera(200.0, 1 + 0.1 * (-1) ** n) for n in range(20)]), 2.0).cameras
    assert cameras is not None and max(abs(float(one.t_cam_world[2]) - 1) for one in cameras[6:-6]) < 0.01 * 0.1
    out = torch.stack([getattr(p, joint) for p in smoothed(trembling, 2.0).params])
    assert float(out[:, 5].abs()[6:-6].max()) < 0.01 * 0.05
    if joint == "neck":
        still = [p.jaw for p in smoothed(trembling, 2.0).params]
        assert all(torch.equal(jaw, rest_params().jaw) for jaw in still)


def test_whose_camera() -> None:
    own, moving = camera(400.0, 2.0), drive(3)
    assert choose_cameras(moving, own, "driver", "driver") == moving.cameras
    assert choose_cameras(moving, own, "target", "driver") == [own] * 3
    assert choose_cameras(replace(moving, cameras=None), own, "driver", "driver") == [own] * 3


def test_the_targets_lens_keeps_the_heads_place_and_size_and_changes_its_perspective() -> None:
    own = camera(800.0, 2.0, size=200, centre=90.0)  # off-centre, a longer lens, other pictures
    moving = drive(2)
    assert moving.cameras is not None
    for before, after in zip(moving.cameras, choose_cameras(moving, own, "driver", "target"), strict=True):
        assert (after.width, after.height) == (100, 100)
        assert (after.fx, after.fy, after.cx, after.cy) == (400.0, 400.0, 45.0, 45.0)
        points = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [0, 0.1, 0], [0.05, 0, 0.1]])
        a, b = before.project(points)[:, :2], after.project(points)[:, :2]
        torch.testing.assert_close(a[:3], b[:3], rtol=0, atol=1e-3)
        assert (a[3] - b[3]).abs().max() > 0.3


def test_the_strip_marks_the_frame_and_says_when_it_is_far() -> None:
    strip = DistanceStrip([0.2, 0.5, 3.0, 0.1], width=300, picture_height=200)
    near, far = strip.frame(0), strip.frame(2)
    assert near.shape == far.shape == (46, 300, 3)
    marks = [(picture == torch.tensor(FAR).numpy()).all(axis=2).sum() for picture in (near, far)]
    assert marks[1] > marks[0], "the mark of a far frame has the colour of far ones"
    assert (far[:14, 186:] == FAR).all(axis=2).any(), "its figure stands to the right of the words"
    assert DistanceStrip([0.2], width=300, picture_height=1000).frame(0).shape == (210, 300, 3)
    assert (near[:, :80] != far[:, :80]).any() and (near[:, 150:260] != far[:, 150:260]).any()


def test_one_frame_has_a_strip_and_the_csv_has_one_line_per_frame() -> None:
    strip = DistanceStrip([0.0], width=64, picture_height=64).frame(0)
    assert strip.shape == (38, 64, 3)
    assert np.flatnonzero((strip[18] == GRID).all(axis=1)).tolist() == [32], "a line down the middle"
    text = distances_csv(("00007", "00009"), (0.5, 1.25))
    assert text.splitlines() == ["frame,name,distance", "0,00007,0.5000", "1,00009,1.2500"]


def test_a_time_that_the_first_camera_did_not_film_is_seen_by_it_all_the_same(tmp_path: Path) -> None:
    folder = write_single(tmp_path)
    (folder / "images" / "00002_08.png").unlink()
    subject, _ = opened(folder, tmp_path / "out", max_left_out=0.1)
    assert subject.recording.cameras[0].name == "08"
    cameras = subject_drive(subject, None).cameras
    assert cameras is not None and {camera.cx for camera in cameras} == {subject.recording.intrinsics[2]}
    assert all(torch.equal(one.head_rotation, one.R_cam_world) and one.R_ref_cam is not None for one in cameras)
    for name, poses in (("R", "R_cam_world"), ("t", "t_cam_world")):
        assert torch.equal(torch.stack([getattr(one, poses) for one in cameras]), subject.recording.tracks[name])
