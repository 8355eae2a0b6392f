"""The command line as a user meets it: judged by output, exit status and files."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.commands.groups import GROUPS
from avatar.data.read_image import read_image
from avatar.files.video import MIN_CAPTION
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint


def test_help_and_version_answer_for_every_command() -> None:
    overview = avatar("--help")
    for command in (name for group in GROUPS.values() for name in group):
        assert command in overview
        assert "usage: avatar" in avatar(command, "--help")
    assert avatar("--version").startswith("avatar ")


def test_what_training_was_made_from_is_recorded(trained: Path, tracked_folder: Path) -> None:
    info = json.loads((trained / "run.json").read_text())
    assert info["source"]["folder"] == str(tracked_folder) and info["source"]["frame_offset"] == 1
    assert info["perceptual"] == "dssim" and info["options"]["model"] == "hypergaussians"
    assert info["config"]["data"]["size"] == 40 and info["config"]["trainer"]["seed"] == 3
    assert len(info["data_hash"]) == len(info["head_fingerprint"]) == 64


def test_eval_prints_the_table_and_writes_what_it_says(trained: Path) -> None:
    output = avatar("eval", trained, "--frames")
    results = json.loads((trained / "eval" / "results.json").read_text())
    for name in ("hypergaussians", "flashavatar", "insta350", "rgbavatar", "strict"):
        assert name in output
        entry = results["protocols"][name]
        assert f"{entry['means']['psnr']:.2f}" in output
        rows = list(csv.DictReader((trained / "eval" / name / "frames.csv").open()))
        assert [row["name"] for row in rows] == entry["frames"]
        assert len(list((trained / "eval" / name / "renders").glob("*.png"))) == len(rows)
    video = trained / "eval" / "truth_render_error.mp4"
    assert str(video) in output
    assert len(iio.imread(video)) == 6  # 20% of 30 frames
    compared = avatar("compare", trained, trained, "--format", "csv", "--out", trained / "compared")
    assert "Written to" in compared
    rows = list(csv.DictReader((trained / "compared" / "compare.csv").open()))
    strict = [row for row in rows if (row["protocol"], row["figure"], row["run"]) == ("strict", "psnr", str(trained))]
    assert [(row["count"], row["difference"]) for row in strict] == [("6", ""), ("6", "0.000000")]
    # compare reads frames.csv, whose figures have six decimals
    assert float(strict[0]["mean"]) == pytest.approx(results["protocols"]["strict"]["means"]["psnr"], abs=1.1e-6)
    assert {path.name for path in (trained / "compared").iterdir()} == {
        f"compare.{s}" for s in ("txt", "md", "tex", "csv")
    }
    assert "hypergaussians" in avatar("eval", trained, "--protocol", "hypergaussians")


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("drivers") / "driver", frames=8, size=48, seed=5)


@pytest.mark.parametrize("transfer", ["raw", "relative", "mean", "pca"])
@pytest.mark.parametrize("camera", ["driver", "target"])
def test_reenact_gives_as_many_frames_as_the_driver_has(
    trained: Path, driver: Path, transfer: str, camera: str
) -> None:
    options = ("--transfer", transfer, "--camera", camera, "--frame-offset", 1)
    output = avatar("reenact", trained, "--driver", driver, *options)
    video = trained / "reenact" / f"driver-{transfer}.mp4"
    assert str(video) in output
    frames = iio.imread(video)
    assert len(frames) == 8
    assert ("Neutral expression: frame" in output) == (transfer in ("relative", "pca"))
    render = frames[:, :40, frames.shape[2] // 2 :]
    assert render.reshape(8, -1).std(axis=1).min() > 5, "the render is empty"


def test_reenact_shows_the_drivers_picture_as_the_video_has_it(trained: Path, driver: Path, tmp_path: Path) -> None:
    avatar("reenact", trained, "--driver", driver, "--frame-offset", 1, "--out", tmp_path / "panel.png")
    panel = read_image(min(tmp_path.glob("*.png")))
    whole = read_image(min(driver.glob("imgs/*"))).astype(np.float32)
    shown = panel[MIN_CAPTION : MIN_CAPTION + 40, :40]
    assert np.abs(shown - cv2.resize(whole, (40, 40), interpolation=cv2.INTER_AREA)).max() <= 1


def test_reenact_records_every_choice_and_each_frames_distance(trained: Path, driver: Path, tmp_path: Path) -> None:
    video = tmp_path / "out.mp4"
    options = ("--strength", 0.5, "--smoothing", 1.5, "--intrinsics", "target", "--frame-offset", 1, "--out", video)
    avatar("reenact", trained, "--driver", driver, *options)
    recorded = json.loads((tmp_path / "out.choices.json").read_text())
    assert recorded["choices"] == {
        "transfer": "relative",
        "strength": 0.5,
        "smoothing": 1.5,
        "camera": "driver",
        "intrinsics": "target",
        "neutral": None,
        "driver_neutral": None,
    }
    assert recorded["driver"] == {"name": "driver", "frames": 8, "fps": 25.0, "has_cameras": True}
    assert recorded["intrinsics"]["shown"]["fx"] == recorded["intrinsics"]["avatar"]["fx"]
    rows = list(csv.DictReader((tmp_path / "out.distances.csv").open()))
    assert [row["name"] for row in rows] == [f"{i:05d}" for i in range(1, 9)]
    far = sum(float(row["distance"]) > 1.0 for row in rows)
    assert recorded["distance"]["frames_above_1"] == far
    for option, value in (("--strength", -1), ("--strength", "nan"), ("--smoothing", -0.5)):
        output = avatar("reenact", trained, "--driver", driver, "--frame-offset", 1, option, value, status=1)
        assert f"{option} must be from 0 to" in output


def test_a_drive_file_drives_like_the_folder_that_it_was_made_from(trained: Path, driver: Path, tmp_path: Path) -> None:
    file, video = tmp_path / "driver.npz", tmp_path / "file.mp4"
    assert str(file) in avatar("drive-file", driver, "--frame-offset", 1, "--out", file)
    avatar("reenact", trained, "--driver", file, "--out", video)
    avatar("reenact", trained, "--driver", driver, "--frame-offset", 1, "--out", tmp_path / "folder.mp4")
    from_file, from_folder = iio.imread(video).astype(float), iio.imread(tmp_path / "folder.mp4").astype(float)
    assert len(from_file) == 8
    width = from_file.shape[2]
    assert width * 2 == from_folder.shape[2], "there is no picture of the driver"
    a, b = from_file[:, 16:56], from_folder[:, 16:56, width:]
    # The encoder makes of the same pictures slightly different ones; other frames differ by far more.
    assert 2 * abs(a - b).mean() < abs(a - np.roll(b, 4, axis=0)).mean()
    files = [tmp_path / "file.distances.csv", tmp_path / "folder.distances.csv"]
    assert files[0].read_text() == files[1].read_text()
    assert "is written as .npz" in avatar("drive-file", driver, "--out", tmp_path / "x.csv", status=1)


def test_a_csv_without_cameras_shows_the_avatars_own(trained: Path, tmp_path: Path) -> None:
    file = tmp_path / "talk.csv"
    file.write_text("time,expression_0,jaw_x,jaw_y,jaw_z\n0,0,0,0,0\n0.1,0.5,0.1,0,0\n0.2,1,0.2,0,0\n")
    output = avatar("reenact", trained, "--driver", file)
    assert "has 1 of 10 expression coefficients; the rest are zero" in output
    recorded = json.loads((trained / "reenact" / "talk-relative.choices.json").read_text())
    assert recorded["driver"] == {"name": "talk", "frames": 3, "fps": pytest.approx(10.0), "has_cameras": False}
    assert recorded["intrinsics"]["shown"] == recorded["intrinsics"]["avatar"]
    assert len(iio.imread(trained / "reenact" / "talk-relative.mp4")) == 3


@pytest.mark.slow
def test_resume_after_kill_9_loses_at_most_the_steps_since_the_last_checkpoint(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed without warning and resumed, the run ends with the bits of one that was never disturbed."""
    options = ["--frame-offset", "1", *SMALL, "trainer.iterations=60", "trainer.checkpoint_every=5"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    monkeypatch.setattr("avatar.train.loss.SH_INTERVAL", 500)  # as in the process that is killed
    avatar("train", tracked_folder, "--out", whole, *options)
    command = [sys.executable, "-m", "avatar.cli", "train", str(tracked_folder), "--out", str(killed), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list_checkpoints(killed / "checkpoints") and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = newest_checkpoint(killed).step
    assert step < 60

    output = avatar("train", tracked_folder, "--out", killed, "--resume")
    assert f"Resuming {killed} at step {step} of 60" in output
    a, b = newest_checkpoint(whole), newest_checkpoint(killed)
    assert a.step == b.step == 60
    assert all(torch.equal(a.tensors[name], b.tensors[name]) for name in a.tensors)


@pytest.mark.slow
def test_ctrl_c_saves_and_says_how_to_go_on(tracked_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = ["--frame-offset", "1", *SMALL, "trainer.iterations=100000", "trainer.checkpoint_every=50"]
    command = [sys.executable, "-m", "avatar.cli", "train", str(tracked_folder), "--out", str(run), *options]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # It is ignored where the tests run in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not list((run / "previews").glob("*.png")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    step = newest_checkpoint(run).step
    assert f"Interrupted at step {step}" in output and "Add --resume" in output


def test_prepare_says_what_it_found(tracked_folder: Path, tmp_path: Path) -> None:
    output = avatar("prepare", tracked_folder, "--out", tmp_path / "prepared")
    assert "image offset 1" in output and "30 frames of 48x48, 24 to train, 6 to test" in output
    assert (tmp_path / "prepared" / "manifest.json").is_file()
