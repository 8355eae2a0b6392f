"""Refinement with several cameras: one move for each time, fitted to the pictures that it may be fitted to."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, picture, screen_errors, wrongly_tracked

from avatar.data.camera_rig import CameraRig, RigCamera
from avatar.data.recording import Recording
from avatar.data.split import Split
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement import fitted_pictures as fitted_module
from avatar.pose_refinement.fitted_pictures import fitted_pictures
from avatar.pose_refinement.refine_subject import Refined, refine_subject
from avatar.pose_refinement.write_results import frames_csv, sheet, summary

TIMES, VIEWS, HELD_OUT = 6, 3, 2  # times 4 and 5 and the last camera are held out


def aside(degrees: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """R and t of a camera that looks from so far aside at what is 0.8 m before the reference camera."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    R = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64)
    return tuple(R.flatten().tolist()), tuple((centre - R @ centre).tolist())


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return patterned_avatar(tmp_path_factory.mktemp("head"))


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    """Each time filmed by three cameras of unlike lenses; the last one films every other time."""
    single = drawn_clip(avatar, frames=TIMES, train=4).recording
    lenses = [tuple(factor * value for value in single.intrinsics[:2]) for factor in (1.0, 1.1, 0.9)]
    places = [aside(degrees) for degrees in (0.0, 50.0, -40.0)]
    cameras = [
        RigCamera(f"cam_{view}", SIZE, SIZE, (*lens, SIZE / 2 + 3 * view, SIZE / 2), *place)
        for view, (lens, place) in enumerate(zip(lenses, places, strict=True))
    ]
    shots = [(time, view) for time in range(TIMES) for view in range(VIEWS) if view != HELD_OUT or time % 2 == 0]
    rig = CameraRig(tuple(cameras), tuple(time for time, _ in shots), tuple(view for _, view in shots))
    train = tuple(index for index, (time, view) in enumerate(shots) if time < 4 and view != HELD_OUT)
    split = Split(train, tuple(index for index in range(len(shots)) if index not in train))
    names = tuple(f"{time:05d}_{view}" for time, view in shots)
    recording = replace(single, rig=rig, names=names, split=split)
    with torch.no_grad():
        pictures = tuple(picture(avatar, recording, index) for index in range(len(shots)))
    records = tuple(SimpleNamespace(tracking=time) for time, _ in shots)
    return Clip(recording, pictures, SimpleNamespace(frames=records))


@pytest.fixture(scope="module")
def wrong(clip: Clip) -> Clip:
    return wrongly_tracked(clip, common=False)


@pytest.fixture(scope="module")
def result(avatar: Avatar, wrong: Clip, tmp_path_factory: pytest.TempPathFactory) -> Refined:
    return refined(avatar, wrong, tmp_path_factory.mktemp("work"))


def refined(avatar: Avatar, clip: Clip, folder: Path) -> Refined:
    found = refine_subject(avatar, cast(Subject, clip), SIZE, BACKGROUND, folder / "progress", lambda _: None)
    assert found is not None
    return found


def of_time(recording: Recording, time: int) -> list[str]:
    return [recording.names[index] for index in fitted_pictures(recording)[time]]


def test_fitted_pictures_of_a_trained_time_are_its_training_pictures(clip: Clip) -> None:
    assert of_time(clip.recording, 0) == ["00000_0", "00000_1"]
    assert of_time(clip.recording, 4) == ["00004_0", "00004_1"]  # a held-out time, by the cameras that are trained on


def test_fitted_pictures_are_those_of_a_held_out_camera_where_there_are_no_others(clip: Clip) -> None:
    rig = replace(clip.recording.rig, cameras=clip.recording.cameras, times=(0, 0, 1), views=(0, 1, 2))
    recording = replace(clip.recording, rig=rig, names=("a", "b", "c"), split=Split((0, 1), (2,)))
    assert fitted_pictures(recording) == [[0, 1], [2]]


def test_fitted_pictures_of_many_cameras_are_those_far_apart(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference camera looks from in front; of those at 50, -40, 10 and -10 degrees the outer two are the farthest."""
    cameras = [replace(clip.recording.cameras[0], R=R, t=t) for R, t in map(aside, (0.0, 10.0, 50.0, -10.0, -40.0))]
    rig = replace(clip.recording.rig, cameras=tuple(cameras), times=(0,) * 5, views=(4, 1, 0, 3, 2))
    recording = replace(clip.recording, rig=rig, names=tuple("abcde"), split=Split(tuple(range(5)), ()))
    monkeypatch.setattr(fitted_module, "MOST_PICTURES", 3)
    assert fitted_pictures(recording) == [[0, 2, 4]]


def test_fitted_pictures_of_one_camera_are_its_frames(avatar: Avatar) -> None:
    assert fitted_pictures(drawn_clip(avatar, frames=3, train=2).recording) == [[0], [1], [2]]


def test_rig_refinement_brings_every_camera_nearer_to_the_truth(
    avatar: Avatar, clip: Clip, wrong: Clip, result: Refined
) -> None:
    assert len(result.before) == TIMES and not result.kept.any()
    assert (result.after > result.before + 3.0).all()
    better = replace(wrong.recording, tracks=result.tracks)
    for view in range(VIEWS):  # the held-out one, too, whose pictures nothing was fitted to
        own = [index for index in range(len(clip)) if clip.recording.view(index) == view]
        before, after = (screen_errors(avatar, one, clip.recording, own) for one in (wrong.recording, better))
        assert after < 0.3 * before, view


def test_rig_refinement_finds_the_depth(avatar: Avatar, clip: Clip, tmp_path: Path) -> None:
    """Which one camera hardly shows."""
    tracks = dict(clip.recording.tracks)
    tracks["t"] = tracks["t"] + 0.002 * torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])[:, None] * torch.eye(3)[2]
    found = refined(avatar, replace(clip, recording=replace(clip.recording, tracks=tracks)), tmp_path)
    errors = (found.tracks["t"] - clip.recording.tracks["t"])[:, 2].abs()
    assert float(errors.max()) < 0.001


def with_noise(clip: Clip, where: Callable[[int], bool]) -> Clip:
    """In place of the pictures of these indices."""
    noise = torch.Generator().manual_seed(0)
    pictures = (
        replace(frame, image=torch.rand(frame.image.shape, generator=noise)) if where(index) else frame
        for index, frame in enumerate(clip.pictures)
    )
    return replace(clip, pictures=tuple(pictures))


def test_noise_in_pictures_of_a_held_out_camera_changes_no_bit(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path
) -> None:
    other = refined(avatar, with_noise(wrong, lambda index: wrong.recording.view(index) == HELD_OUT), tmp_path)
    assert all(torch.equal(other.tracks[name], value) for name, value in result.tracks.items())


def test_noise_at_held_out_times_changes_no_bit_of_trained_ones(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path
) -> None:
    other = refined(avatar, with_noise(wrong, lambda index: wrong.recording.time(index) > 3), tmp_path)
    for name, value in result.tracks.items():
        assert torch.equal(other.tracks[name][:4], value[:4])
    assert not torch.equal(other.tracks["t"], result.tracks["t"])


def test_the_record_of_a_rig_has_a_line_for_each_time(avatar: Avatar, wrong: Clip, result: Refined) -> None:
    subject, centre = cast(Subject, wrong), avatar.head.neutral_vertices().mean(dim=0)
    lines = frames_csv(subject, result, centre).splitlines()[1:]
    assert [line.split(",")[:3] for line in lines[3:]] == [
        ["3", "00003_0", "train"],
        ["4", "00004_0", "test"],
        ["5", "00005_0", "test"],
    ]
    split = wrong.recording.split
    seen = tuple(i for i in split.train if wrong.recording.view(i) != 0)
    without = replace(wrong, recording=replace(wrong.recording, split=split._replace(train=seen)))
    lines = frames_csv(cast(Subject, without), result, centre).splitlines()[1:]
    assert [line.split(",")[1] for line in lines[3:]] == ["00003_1", "00004_1", "00005_1"], "fitted pictures are named"
    said = summary(subject, result, centre)
    assert f"{result.after[4:].mean():.2f} dB" in next(line for line in said if line.startswith("held-out"))
    after = replace(wrong.recording, tracks=result.tracks)
    assert sheet(avatar, subject, result, after, SIZE, BACKGROUND).startswith(b"\x89PNG")


def test_the_summary_of_a_rig_without_held_out_times_leaves_them_out(
    avatar: Avatar, wrong: Clip, result: Refined
) -> None:
    recording = wrong.recording
    trained = {recording.time(index) for index in recording.split.train}
    train = tuple(i for i in range(len(wrong)) if recording.view(i) != HELD_OUT)
    split = Split(train, tuple(i for i in range(len(wrong)) if i not in train))
    own = replace(wrong, recording=replace(recording, split=split))
    assert trained == {0, 1, 2, 3} and np.isfinite(result.after).all()
    said = summary(cast(Subject, own), result, avatar.head.neutral_vertices().mean(dim=0))
    assert not any(line.startswith("held-out") or "nan" in line for line in said)
