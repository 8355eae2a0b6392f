"""The demo person as a plain video: the same person and motion as the subject, in a room, with a sensor's noise."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from avatar.cli import main
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.raw_video import expose, filmed, make_room, make_street, make_video
from avatar.demo.render import render_frame
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.track.footage.source import Span, whole
from data_prep.track.footage.video import open_video

SEED, SIZE, FRAMES = 1, 96, 3


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return list(filmed(FRAMES, SIZE, SEED))


def test_the_person_is_the_subjects_and_the_room_is_not(pictures: list[np.ndarray]) -> None:
    performance = perform(SEED, FRAMES, "speech")
    for n in (0, FRAMES - 1):
        truth = render_frame(SEED, frame_params(performance, n), frame_camera(performance, n, SIZE))
        inside, outside = truth.alpha == 255, truth.alpha == 0
        error = pictures[n].astype(float) - truth.image
        assert abs(error[inside].mean()) < 0.2 and 0.5 < error[inside].std() < 4.0  # noise around the truth
        room = make_room(SIZE, SEED)
        assert np.abs(pictures[n][outside] - room[outside]).mean() < 4.0
        assert np.abs(truth.image[outside] - room[outside]).mean() > 20.0
        # At the edge the person is as much there as the matte says, once and not squared.
        edge = (truth.alpha > 60) & (truth.alpha < 200)
        assert edge.sum() > 50 and abs((pictures[n] - truth.image.astype(float))[edge].mean()) < 60


def test_noise_grows_with_the_light() -> None:
    rng = np.random.default_rng(0)
    spread = [expose(np.full((64, 64, 3), level, np.float32), rng).std() for level in (10, 90, 200)]
    assert spread[0] < spread[1] < spread[2] < 5.0


def test_it_repeats_and_every_seed_has_its_room(pictures: list[np.ndarray]) -> None:
    for one, other in zip(pictures, filmed(FRAMES, SIZE, SEED), strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(make_room(SIZE, 1) - make_room(SIZE, 2)).mean() > 10


@pytest.mark.slow
def test_outdoors_the_background_moves_behind_the_same_person(pictures: list[np.ndarray]) -> None:
    first, second = (list(filmed(FRAMES, SIZE, SEED, outdoors=True)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    performance = perform(SEED, FRAMES, "speech")
    truth = [
        render_frame(SEED, frame_params(performance, n), frame_camera(performance, n, SIZE)) for n in range(FRAMES)
    ]
    mouth = truth[0].mouth == 255
    assert np.abs(first[0].astype(float) - pictures[0])[mouth].mean() < 3.0
    street = list(islice(make_street(SIZE, SEED), 40))
    assert street[0].shape == (SIZE, SIZE, 3) and street[0].dtype == np.float32
    assert 2.0 < np.abs(street[1] - street[0]).mean() < np.abs(street[39] - street[0]).mean()
    for n in (0, FRAMES - 1):
        far = cv2.erode((truth[n].alpha == 0).astype(np.uint8), np.ones((25, 25), np.uint8)) > 0  # from loose hair too
        assert far.sum() > 500 and np.abs(first[n] - street[n])[far].mean() < 4.0


@pytest.mark.slow
def test_the_command_writes_a_video_and_a_head_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, head = tmp_path / "me.mp4", tmp_path / "head_model"
    options = ["--video", "--frames", "3", "--size", "96"]
    assert main(["demo-data", str(out), *options, "--seed", "1"]) == 0
    assert f"avatar create {out} --head {head}" in capsys.readouterr().out
    video = open_video(out)
    assert (video.width, video.height, video.rate) == (96, 96, 25.0)
    assert len(list(video.read(whole(96, 96), Span(), lambda said: None))) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["head_model", "me.mp4"]
    assert load_head_assets(head).num_vertices > 1000
    # The name alone says that it is a video; one head model is enough for all of them.
    assert main(["demo-data", str(tmp_path / "you.mp4"), *options[1:], "--seed", "2", "--outdoors"]) == 0
    assert f"--head {head}" in capsys.readouterr().out and open_video(tmp_path / "you.mp4").width == 96
    assert main(["demo-data", str(tmp_path / "folder"), "--outdoors"]) == 1
    assert "--outdoors is of a video: add --video" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["me.webm", "me.MOV", "me.avi"])
def test_a_folder_is_not_called_like_a_video(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo-data", str(tmp_path / name), "--frames", "1", "--size", "64"]) == 1
    assert "a video is written as .mp4" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a video is written as .mp4"):
        make_video(tmp_path / "me", 3, 96)
    (tmp_path / "me.mp4").write_bytes(b"mine")
    with pytest.raises(UserError, match="me.mp4 exists; choose another name"):
        make_video(tmp_path / "me.mp4", 3, 96)
    with pytest.raises(UserError, match="frames must be from 1"):
        make_video(tmp_path / "new.mp4", 0, 96)
    assert (tmp_path / "me.mp4").read_bytes() == b"mine" and not (tmp_path / "new.mp4").exists()
