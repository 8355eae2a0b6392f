"""Training, resuming, evaluating and driving with several cameras, on a person that is filmed by three."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import pytest
import torch
from camera_rig_folder import edited, write_single
from small_runs import SMALL

from avatar.cli import main
from avatar.data.recording import Recording
from avatar.gaussianheadavatar import model as gaussianheadavatar
from avatar.pipeline.open_inputs import open_run
from avatar.runs.avatar_file import read_avatar_file
from avatar.runs.checkpoint import newest_checkpoint
from avatar.train.step_runner import Kind

OPTIONS = (*SMALL, "trainer.perceptual=dssim", "data.size=48")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """EMO/ with three cameras, and runs/whole, trained on two of them."""
    root = tmp_path_factory.mktemp("training")
    folder = write_single(root)
    assert main(["train", str(folder), "--out", str(root / "whole"), *options(root)]) == 0
    return root


def options(root: Path) -> list[str]:
    return ["--head", str(root / "head_model"), *OPTIONS]


def test_a_resumed_run_ends_with_the_same_bits(place: Path, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    assert main(["train", str(place / "EMO"), "--out", str(begun), *options(place)]) == 0
    for later in sorted((begun / "checkpoints").iterdir())[1:]:
        later.unlink()  # as if it had been killed before
    assert main(["train", "--out", str(begun), "--resume"]) == 0
    resumed, whole = (newest_checkpoint(run) for run in (begun, place / "whole"))
    assert resumed.step == whole.step == 12
    assert all(torch.equal(value, resumed.tensors[name]) for name, value in whole.tensors.items())
    assert whole.tensors["pose_corrections.moves"].shape == (4, 5)  # of times, not of pictures


def test_steps_of_cameras_with_different_lenses_are_not_replayed_by_one_graph(place: Path) -> None:
    recording = open_run(place / "whole", say=lambda _: None).subject.recording
    cameras = [recording.camera(i) for i in recording.split.train]
    inputs: Any = [SimpleNamespace(frame=SimpleNamespace(camera=c), crop_rows=None, crop_columns=None) for c in cameras]
    kinds = {Kind.of(0, one, None) for one in inputs}
    assert len(kinds) == len({c.cx for c in cameras}) == 2 and len({kind.size for kind in kinds}) == 1


@pytest.mark.parametrize("option", [[], ["--dry-run"]])
def test_pictures_of_one_camera_that_are_too_small_are_refused_before_training(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    def widened(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == "12":
            entry |= {key: 4 * entry[key] for key in ("w", "fl_x", "cx")}

    folder = edited(place / "EMO", tmp_path / "wide", widened)
    for path in folder.glob("*/*_12.png"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=4, fy=1))
    words = ["train", str(folder), "--out", str(tmp_path / "run"), *options(place), "data.size=16", *option]
    assert main(words) == 1
    assert "needs frames of at least 11x11 pixels, these have 16x4" in capsys.readouterr().err


def test_the_avatar_file_holds_the_rig(place: Path) -> None:
    kept = read_avatar_file(place / "whole" / "avatar.safetensors").recording
    trained = open_run(place / "whole", say=lambda _: None).subject.recording
    assert kept.rig == trained.rig and len(kept.cameras) == 3
    for index in (0, len(kept) - 1):
        assert torch.equal(kept.camera(index).R_cam_world, trained.camera(index).R_cam_world)


def test_figures_tell_held_out_times_and_cameras_apart(place: Path) -> None:
    run = place / "whole"
    assert main(["eval", str(run), "--protocol", "strict", "--verify"]) == 0
    entry = json.loads((run / "eval" / "results.json").read_text())["protocols"]["strict"]
    assert {one["name"]: one["frames"] for one in entry["by_held_out"]} == {
        "camera": 4,  # 08 at the times of training
        "time": 4,  # 07 and 12 at the others
        "time and camera": 2,
    }
    assert {one["name"] for one in entry["by_camera"]} == {
        *("08, camera", "08, time and camera", "07, time", "12, time"),
    }
    rows = list(csv.DictReader((run / "eval" / "strict" / "frames.csv").open()))
    # 08 at times 0 to 5: those between two others have a jitter; 07 and 12 have two held-out times each.
    assert [(row["camera"], row["time"]) for row in rows if row["jitter"] != "nan"] == [
        ("08", str(time)) for time in range(1, 5)
    ]
    shown = sum(one["means"]["psnr"] * one["frames"] for one in entry["by_held_out"]) / len(rows)
    assert shown == pytest.approx(entry["means"]["psnr"], abs=1e-9)


def test_it_drives_another_avatar_with_one_frame_of_each_time(place: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    command = ["reenact", str(place / "whole"), str(place / "EMO"), "--head", str(place / "head_model")]
    assert main([*command, "--out", str(film)]) == 0
    table = list(csv.reader(film.with_name("film.distances.csv").open()))
    assert [row[1] for row in table[1:]] == [f"{time:05d}_08" for time in range(6)]


@pytest.mark.slow
def test_its_tracking_is_refined_and_trained_on(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = place / "refining"
    command = ["train", str(place / "EMO"), "--out", str(run), "--refine", "1", *options(place)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "Refining 18 frames, pictures of 6 times, of EMO" in said
    opened = open_run(run, say=lambda _: None).subject
    whole = open_run(place / "whole", say=lambda _: None).subject
    assert opened.recording.rig == whole.recording.rig and opened.split == whole.split
    assert opened.manifest.refinement is not None and opened.given is not None
    assert opened.manifest.refinement.rounds[0].trained_on == whole.split.train
    assert main(["eval", str(run), "--protocol", "strict"]) == 0
    assert "(!)" not in capsys.readouterr().out
    results = json.loads((run / "eval" / "results.json").read_text())
    entry = results["protocols"]["strict"]
    assert {one["name"] for one in entry["by_held_out"]} == {"camera", "time", "time and camera"}
    assert entry["tracked"]["means"]["psnr"] > 10.0


def test_the_network_gets_the_same_turn_whichever_camera_looks(place: Path) -> None:
    trained = open_run(place / "whole", say=lambda _: None).trained
    recording: Recording = trained.recording
    same_time = [index for index in range(len(recording)) if recording.time(index) == 2]
    seen = [trained.gaussians(recording.params(index), recording.camera(index)) for index in same_time]
    for other in seen[1:]:
        torch.testing.assert_close(other.means, seen[0].means, atol=1e-6, rtol=0)


@pytest.mark.slow
def test_a_run_with_zoom_resumes_with_the_same_bits(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gaussianheadavatar, "STEPS", 12)  # fewer have no zoom

    def trained(name: str) -> Path:
        command = ["train", str(place / "EMO"), "--out", str(tmp_path / name), "model=gaussianheadavatar"]
        assert main([*command, *options(place)]) == 0
        return tmp_path / name

    whole = newest_checkpoint(trained("whole"))
    begun = trained("begun")
    for later in sorted((begun / "checkpoints").iterdir())[1:]:
        later.unlink()
    assert main(["train", "--out", str(begun), "--resume"]) == 0
    resumed = newest_checkpoint(begun)
    assert resumed.step == whole.step == 12
    assert all(torch.equal(value, resumed.tensors[name]) for name, value in whole.tensors.items())
    monkeypatch.setattr(gaussianheadavatar, "ZOOM", None)
    unzoomed = newest_checkpoint(trained("unzoomed"))
    assert any(not torch.equal(value, unzoomed.tensors[name]) for name, value in whole.tensors.items())
