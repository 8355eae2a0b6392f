"""A folder whose division into training and test frames changes after the training."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from camera_rig_folder import write_listings, write_single
from command_line import avatar
from small_runs import SMALL

from avatar.runs.checkpoint import list_checkpoints

pytestmark = pytest.mark.slow


def divide(folder: Path, tested: range) -> None:
    """List the times `tested` for testing, and the others for training."""
    every = [entry for path in folder.glob("transforms_*.json") for entry in json.loads(path.read_text())["frames"]]
    entries = {entry["file_path"]: entry for entry in every}.values()
    train = [entry for entry in entries if entry["timestep_index"] not in tested]
    write_listings(folder, {"train": train, "test": [entry for entry in entries if entry not in train], "val": []})


@pytest.mark.parametrize("cameras", ["12", "all"])
def test_frames_that_were_trained_on_are_not_held_out_later(cameras: str, tmp_path: Path) -> None:
    folder, run = write_single(tmp_path), tmp_path / "run"
    divide(folder, range(4, 6))
    avatar("train", folder, "--head", tmp_path / "head_model", "--out", run, "--cameras", cameras, *SMALL)
    list_checkpoints(run / "checkpoints")[-1].unlink()
    divide(folder, range(2))
    for words in (("eval", run), ("refine", run), ("train", "--resume", run)):
        assert "is divided into training and test frames otherwise than when" in avatar(*words, status=1)
    divide(folder, range(4, 6))
    assert "12/12" in avatar("train", "--resume", run)
    avatar("eval", run, "--protocol", "strict")
