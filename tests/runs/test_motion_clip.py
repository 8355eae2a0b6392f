"""Frames of an avatar's own video, and others' motion, as a film."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import torch
from drawn_clip import true_tracks
from small_runs import train_small

from avatar.data.camera_rig import CameraRig, RigCamera
from avatar.data.recording import Recording
from avatar.data.split import Split
from avatar.motion.controls import turned
from avatar.motion.drive import Drive
from avatar.runs.avatar_file import AVATAR_FILE
from avatar.runs.motion_clip import driven_clip, own_clip
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar


def filmed_by_two(test: tuple[int, ...]) -> TrainedAvatar:
    """Pictures 2 n and 2 n + 1 are of time n, by a small and by a large camera."""
    cameras = tuple(
        RigCamera(name, side, side, (2.0 * side, 2.0 * side, side / 2, side / 2))
        for name, side in (("a", 32), ("b", 48))
    )
    train = tuple(index for index in range(12) if index not in test)
    recording = Recording(
        name="someone",
        fps=25.0,
        width=32,
        height=32,
        intrinsics=cameras[0].intrinsics,
        names=tuple(f"{index:02d}" for index in range(12)),
        split=Split(train, test),
        tracks=true_tracks(6),
        data_hash="",
        head_fingerprint="",
        rig=CameraRig(cameras, tuple(index // 2 for index in range(12)), (0, 1) * 6),
    )
    return cast(TrainedAvatar, SimpleNamespace(recording=recording))


def test_a_film_of_held_out_frames_is_of_one_camera() -> None:
    """Of the second one, which is held out at all times; the first one at the last times."""
    trained = filmed_by_two((1, 3, 5, 7, 8, 9, 10, 11))
    clip = own_clip(trained, "test")
    assert clip.recorded == (1, 3, 5, 7, 9, 11)
    assert {camera.width for _, camera in clip.frames} == {48}
    assert own_clip(trained, "train").recorded == (0, 2, 4, 6)
    assert own_clip(trained, "all").recorded == (0, 2, 4, 6, 8, 10)


def test_a_time_that_the_camera_did_not_film_is_seen_by_it_too() -> None:
    """The picture that is beside it is another camera's."""
    trained = filmed_by_two((2, 5, 7, 9))
    clip = own_clip(trained, "test")
    assert clip.recorded == (2, 5, 7, 9)
    for size, side in ((None, 48), (24, 24)):
        cameras = [camera for _, camera in own_clip(trained, "test", size).frames]
        assert {(camera.width, camera.height, camera.fx) for camera in cameras} == {(side, side, 2.0 * side)}
    assert all(
        torch.equal(camera.t_cam_world, trained.recording.tracks["t"][time])
        for time, (_, camera) in enumerate(clip.frames, start=1)
    )


def test_before_a_camera_that_stands_still_the_torso_does_too(tracked_folder: Path, tmp_path: Path) -> None:
    """As `avatar reenact` shows it: the head's own turns are not known, and the torso alone would turn beneath it."""
    train_small(tracked_folder, tmp_path)
    trained = load_avatar(tmp_path / AVATAR_FILE, tracked_folder / "head_model")
    recording = trained.recording
    params = [replace(recording.params(i), neck=turned(0.1 * i, 0.2)) for i in range(3)]
    still = Drive("someone", 25.0, ("0", "1", "2"), params, None, recording.identity)
    assert all(torch.equal(p.neck, trained.rest_params().neck) for p, _ in driven_clip(trained, still).frames)
    moving = replace(still, cameras=[recording.camera(i) for i in range(3)])
    assert all(
        torch.equal(p.neck, q.neck) for (p, _), q in zip(driven_clip(trained, moving).frames, params, strict=True)
    )
