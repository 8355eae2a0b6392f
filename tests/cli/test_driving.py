"""Drivers as people have them: a single frame, a video of another frame rate; and what of them is recorded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from camera_rig_folder import SEQUENCES, write_listings, write_sequence
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.cli import main
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.motion.drive import Drive
from avatar.pipeline.reenact import Choices, reenact
from avatar.runs.trained_avatar import load_avatar
from avatar.types import Camera, HeadParams, Rendering


@pytest.fixture(scope="module")
def run(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained on a video of 30 frames a second."""
    run = tmp_path_factory.mktemp("runs") / "run"
    options = ["--frame-offset", "1", "--size", "40", "--fps", "30", *SMALL, "trainer.iterations=4"]
    assert main(["train", str(tracked_folder), "--out", str(run), *options]) == 0
    return run


@pytest.fixture
def still(tmp_path: Path) -> Path:
    return write_tracked_folder(tmp_path / "still", frames=1, size=48, seed=5)


def test_a_single_frame_drives_once_its_offset_is_given(
    run: Path, still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reenact", str(run), "--driver", str(still), "--out", str(tmp_path / "still.mp4")]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert (
        "there are too few frames to find the offset between images and tracking (1 images, 1 tracking frames" in said
    )
    assert "lie on" not in said and "give --frame-offset (1 where images are numbered from 1" in said
    for transfer in ("raw", "relative", "mean", "pca"):
        assert main([*command, "--frame-offset", "1", "--transfer", transfer]) == 0
        assert len(iio.imread(tmp_path / "still.mp4")) == 1
    assert (
        "note: there is a single frame: it can drive an avatar, and none can be trained on it"
        in capsys.readouterr().out
    )
    shutil.rmtree(still / "head_model")  # then it is read with the avatar's
    assert main([*command, "--frame-offset", "1"]) == 0


def test_a_single_frame_makes_a_drive_file(still: Path, tmp_path: Path) -> None:
    file = tmp_path / "still.npz"
    assert main(["drive-file", str(still), "--frame-offset", "1", "--out", str(file)]) == 0
    assert len(np.load(file)["expression"]) == 1


def test_a_single_frame_is_not_trained_on(still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", str(still), "--frame-offset", "1", "--out", str(tmp_path / "run")]
    for more in ([], ["--refine", "1"]):
        assert main([*words, *more]) == 1
        assert "the subject has 1 usable frame(s); at least 2 are needed, one to train" in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    assert main(["check", str(still), "--frame-offset", "1", "--json"]) == 2
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert [one["check"] for one in findings if one["severity"] == "error"] == ["too-few-frames"]


def test_one_time_of_several_cameras_drives_and_is_not_trained_on(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = replace(SEQUENCES[0], times=1)
    folder = write_listings(tmp_path / sequence.name, {None: write_sequence(tmp_path, sequence)})
    head = ["--head", str(tmp_path / "head_model")]
    video = tmp_path / "one.mp4"
    assert main(["reenact", str(run), "--driver", str(folder), "--out", str(video), *head]) == 0
    assert len(iio.imread(video)) == 1
    assert main(["drive-file", str(folder), "--out", str(tmp_path / "one.npz"), *head]) == 0
    assert "\n1 frames written" in (said := capsys.readouterr().out)
    assert "the pictures are of a single time" in said
    for held_out in ([], ["data.test_cameras=08"], ["data.test_frames=1"]):
        assert main(["train", str(folder), "--out", str(tmp_path / "run"), *head, *held_out]) == 1
        assert "3 pictures are all of one time; at least 2 times are needed" in capsys.readouterr().err
    assert not (tmp_path / "run" / "run.json").exists()


def test_the_frame_rate_of_a_video_stays_with_the_avatar(run: Path, tracked_folder: Path) -> None:
    assert json.loads((run / "run.json").read_text())["source"]["fps"] == 30.0
    assert load_avatar(run, tracked_folder / "head_model").recording.fps == 30.0
    assert main(["eval", str(run), "--protocol", "strict"]) == 0
    assert iio.immeta(run / "eval" / "truth_render_error.mp4")["fps"] == 30.0


def test_the_frame_rate_of_a_driver_is_that_of_its_video_and_its_drive_file(
    run: Path, tracked_folder: Path, tmp_path: Path
) -> None:
    folder = write_tracked_folder(tmp_path / "driver", frames=8, size=48, seed=5)
    reading = ["--frame-offset", "1", "--fps", "60"]
    file, video = tmp_path / "driver.npz", tmp_path / "driver.mp4"
    assert main(["drive-file", str(folder), *reading, "--out", str(file)]) == 0
    assert float(np.load(file)["fps"]) == 60.0
    for driver in ([str(folder), *reading], [str(file)]):
        assert main(["reenact", str(run), "--driver", *driver, "--out", str(video)]) == 0
        meta = iio.immeta(video)
        assert meta["fps"] == 60.0 and meta["duration"] == pytest.approx(8 / 60, abs=0.02)
        assert json.loads((tmp_path / "driver.choices.json").read_text())["driver"]["fps"] == 60.0
    assert main(["prepare", str(folder), *reading, "--out", str(tmp_path / "prepared")]) == 0
    assert Subject.open(tmp_path / "prepared").recording.fps == 60.0


def test_the_torso_turns_against_no_head_that_does_not_turn(
    run: Path, tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = load_avatar(run, tracked_folder / "head_model")
    necks = [torch.tensor([1.0, 0.1 * i, 0.0, 0.0, 1.0, 0.0]) for i in range(3)]
    params = [replace(trained.recording.params(i), neck=neck) for i, neck in enumerate(necks)]
    cameras, shown = [trained.recording.camera(i) for i in range(3)], list[torch.Tensor]()

    def stream(_: object, frames: Iterable[tuple[HeadParams, Camera]]) -> Iterator[Rendering]:
        for own, camera in frames:
            shown.append(own.neck)
            yield trained.render(own, camera)

    monkeypatch.setattr(type(trained), "stream", stream)
    own = trained.rest_params().neck
    for given, whose, expected in (
        (cameras, "driver", necks),
        (cameras, "target", [own] * 3),
        (None, "driver", [own] * 3),
    ):
        drive = Drive("a", 10.0, ("1", "2", "3"), params, given, torch.zeros(0))
        shown.clear()
        reenact(trained, drive, tmp_path / "a.mp4", Choices(transfer="raw", camera=whose))
        torch.testing.assert_close(torch.stack(shown), torch.stack(expected))
    with pytest.raises(UserError, match="--strength must be from 0 to 10"):
        reenact(trained, drive, tmp_path / "a.mp4", Choices(strength=11.0))


def test_eval_verifies_what_it_has_written(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(run), "--verify", "--protocol", "strict", "--protocol", "hypergaussians"]) == 0
    said = capsys.readouterr().out
    assert said.count("PSNR, SSIM and jitter of 6 frames verified from their pictures") == 2
    entries = json.loads((run / "eval" / "results.json").read_text())["protocols"]
    assert all(entry["verified"]["frames"] == 6 for entry in entries.values())
    assert len(list((run / "eval" / "strict" / "renders").glob("*.png"))) == 6


def test_eval_that_does_not_agree_with_its_pictures_fails(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from avatar.evaluation import measure

    real = measure.ssim_map
    monkeypatch.setattr(measure, "ssim_map", lambda *images: real(*images) * 0.9999)
    assert main(["eval", str(run), "--verify", "--protocol", "strict"]) == 1
    error = capsys.readouterr().err
    assert "avatar: ssim of frame 00025 is 0." in error and "strict/frames.csv, but its pictures give 0." in error
    assert "verified" not in json.loads((run / "eval" / "results.json").read_text())["protocols"]["strict"]
