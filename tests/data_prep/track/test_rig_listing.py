"""What is written of a rig is what the reader of VHAP's layout finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from rig_recording import FILMED

from avatar.head.assets import load_head_assets
from avatar.head.model import matrix_from_6d
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.rig import Pose
from data_prep.track.footage.pictures import PictureFolder
from data_prep.track.footage.source import Box, View
from data_prep.track.rig.listing import write_listing, write_parameters
from data_prep.track.rig.recording import Camera

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


def test_the_reader_finds_what_was_written(tmp_path: Path, demo_head_model: Path) -> None:
    head = load_head_assets(demo_head_model)
    tracks = {n: a_track(n) for n in (3, 4, 6)}
    cameras: dict[str, Camera] = {}
    for serial, one in FILMED.items():
        footage = PictureFolder(tmp_path, 2 * WIDTH, 2 * HEIGHT, 25.0, 1.0, None, (), ())
        lens = np.array([one.K[0, 0], one.K[1, 1], one.K[0, 2], one.K[1, 2]])
        cameras[serial] = Camera(footage, one.pose[:3, :3], one.pose[:3, 3], lens)
    views = dict.fromkeys(cameras, View(Box(0, 0, 2 * WIDTH, 2 * HEIGHT), WIDTH, HEIGHT))
    front = Pose(cameras[FRONT].R, SCALE * cameras[FRONT].t)
    write_parameters(tmp_path, tracks, front.inverse(), head)
    write_listing(tmp_path, cameras, views, list(tracks), SCALE, 24.5)

    opened = open_tracked_folder(tmp_path)
    found = opened.read(head, (WIDTH, HEIGHT), pytest.fail)
    assert opened.fps == 24.5 and not found.bad and len(found.frames) == 9
    assert opened.files.images[0] == tmp_path / "images" / "220700191" / "00003.jpg"
    for number, track in found.frames.items():
        camera, wanted = opened.shots[number].camera, tracks[list(tracks)[opened.shots[number].time]]
        own = cameras[camera]
        pose = Pose(own.R, SCALE * own.t).after(front.inverse()).after(Pose(wanted.R, wanted.t))
        assert np.allclose(track.R, pose.R, atol=1e-5) and np.allclose(track.t, pose.t, atol=1e-5)
        assert np.allclose(track.intrinsics, own.intrinsics / 2) and track.size == (WIDTH, HEIGHT)
        for name in ("jaw", "eyes", "eyelids", "neck", "expression", "shape"):
            assert np.allclose(getattr(track, name), getattr(wanted, name), atol=1e-5), name
