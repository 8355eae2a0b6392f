"""What is written of a rig is what the reader of VHAP's layout finds, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rig_recording import FILMED

from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import matrix_from_6d
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.camera_rig import Pose
from data_prep.progress import silent
from data_prep.track.camera_rig import track_rig
from data_prep.track.camera_rig.camera_pictures import Times
from data_prep.track.camera_rig.recording import Camera, Recording
from data_prep.track.camera_rig.track_rig import _RigTracking
from data_prep.track.camera_rig.vhap_listing import write_listing, write_parameters
from data_prep.track.footage.picture_folder import PictureFolder
from data_prep.track.footage.source import Box, View
from data_prep.track.stage_folder import StageFolder

WIDTH, HEIGHT, SCALE, FRONT = 80, 60, 1.07, "222200037"


def a_track(seed: int) -> FrameTrack:
    rng = np.random.default_rng(seed)

    def turns(count: int) -> np.ndarray:
        return matrix_from_6d(torch.from_numpy(np.eye(3)[:2].ravel() + 0.1 * rng.normal(size=(count, 6)))).numpy()

    jaw, left, right, neck = turns(4)[:, :2].reshape(4, 6)
    return FrameTrack(
        expression=rng.normal(size=8),
        jaw=jaw,
        eyes=np.concatenate((left, right)),
        eyelids=rng.random(2),
        neck=neck,
        R=turns(1)[0] @ np.diag([1.0, -1.0, -1.0]),
        t=np.array([0.02, 0.05, 1.1]),
        shape=np.array([0.4, -0.7]),
        intrinsics=np.ones(4),
        size=(WIDTH, HEIGHT),
    )


def filmed() -> dict[str, Camera]:
    footage = PictureFolder(Path("images"), 2 * WIDTH, 2 * HEIGHT, 25.0, 1.0, None, (), ())
    poses = {serial: (one.pose[:3, :3], one.pose[:3, 3]) for serial, one in FILMED.items()}
    return {s: Camera(footage, *poses[s], one.K[[0, 1, 0, 1], [0, 1, 2, 2]]) for s, one in FILMED.items()}


def test_the_reader_finds_what_was_written(tmp_path: Path, demo_head_model: Path) -> None:
    head, cameras = load_head_assets(demo_head_model), filmed()
    tracks = {n: a_track(n) for n in (3, 4, 6)}
    views = dict.fromkeys(cameras, View(Box(0, 0, 2 * WIDTH, 2 * HEIGHT), WIDTH, HEIGHT))
    front = Pose(cameras[FRONT].R, SCALE * cameras[FRONT].t)
    write_parameters(tmp_path, tracks, front.inverse(), head)
    write_listing(tmp_path, cameras, views, list(tracks), SCALE, 24.5)

    opened = open_tracked_folder(tmp_path)
    found = opened.read(head, (WIDTH, HEIGHT), pytest.fail)
    assert opened.fps == 24.5 and not found.bad and len(found.frames) == 9
    assert opened.files.images[0] == tmp_path / "images" / "220700191" / "00003.jpg"
    for number, track in found.frames.items():
        camera, wanted = opened.shots[number].camera, tracks[3 + opened.shots[number].time]
        own = cameras[camera]
        pose = Pose(own.R, SCALE * own.t).after(front.inverse()).after(Pose(wanted.R, wanted.t))
        assert np.allclose(track.R, pose.R, atol=1e-5) and np.allclose(track.t, pose.t, atol=1e-5)
        assert np.allclose(track.intrinsics, own.intrinsics / 2) and track.size == (WIDTH, HEIGHT)
        for name in ("jaw", "eyes", "eyelids", "neck", "expression", "shape"):
            assert np.allclose(getattr(track, name), getattr(wanted, name), atol=1e-5), name


@pytest.fixture
def rig(tmp_path: Path, demo_head_model: Path) -> _RigTracking:
    stages = StageFolder(tmp_path / ".out.partial")
    opened = Recording(tmp_path, filmed(), FRONT)
    return _RigTracking(stages, opened, FRONT, demo_head_model, load_head_assets(demo_head_model), WIDTH)


def test_nothing_is_left_of_cameras_and_heads_of_an_earlier_call(rig: _RigTracking, tmp_path: Path) -> None:
    for kind in ("images", "fg_masks"):
        for serial in (*FILMED, "222200099", "222200099.partial"):
            (tmp_path / ".out.partial" / kind / serial).mkdir(parents=True)
    for numbers in ((3, 4, 6), (3, 4)):
        rig.write({n: a_track(n) for n in numbers}, SCALE, 25.0)
    for kind in ("images", "fg_masks"):
        assert {path.name for path in (tmp_path / ".out.partial" / kind).iterdir()} == set(FILMED)
    assert len([*(tmp_path / ".out.partial" / "flame_param").iterdir()]) == 2


def test_a_full_disk_is_refused(rig: _RigTracking, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("images", "fg_masks"):
        (tmp_path / ".out.partial" / kind).mkdir(parents=True)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(UserError, match=r"\.out\.partial cannot be written \(No space left on device\)"):
        rig.write({3: a_track(3)}, SCALE, 25.0)


@pytest.mark.parametrize("name", ["R", "t", "intrinsics"])
def test_mattes_are_made_again_for_another_calibration(
    rig: _RigTracking, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    made: list[int] = []
    monkeypatch.setattr(track_rig, "write_head_mattes", lambda *_: made.append(1))
    side, tracks = next(iter(FILMED)), {3: a_track(3)}

    def mattes() -> int:
        rig.mattes(side, tracks, SCALE, Times([3], 0.0, 25.0), None, None, "key", silent)  # type: ignore[arg-type]
        return len(made)

    assert mattes() == mattes() == 1
    camera = rig._cameras[side]
    rig._cameras[side] = replace(camera, **{name: 1.01 * getattr(camera, name)})
    assert mattes() == 2
