"""Frames a second: what the person says, else what the folder records, else 25, which is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from exports import write_imavatar, write_insta, write_vhap
from importing import import_folder

from avatar.cli import main
from avatar.head.assets import load_head_assets
from data_prep.check.folder import check_tracked_folder

WRITERS: dict[str, Callable[..., Path]] = {"VHAP": write_vhap, "INSTA": write_insta, "IMavatar": write_imavatar}


def record(folder: Path, fps: object) -> None:
    for path in [*folder.glob("transforms*.json"), *folder.glob("flame_params.json")]:
        path.write_text(json.dumps(json.loads(path.read_text()) | {"fps": fps}))


@pytest.mark.parametrize("format", WRITERS)
def test_a_recorded_frame_rate_is_taken_and_can_be_overruled(format: str, tracked: Path, tmp_path: Path) -> None:
    folder = WRITERS[format](tracked, tmp_path / "folder")
    record(folder, 29.97)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert subject.recording.fps == subject.manifest.fps == 29.97 and "29.97 a second, in" in said[-1]
    subject, said = import_folder(folder, tracked, tmp_path / "out", fps=50.0)
    assert subject.recording.fps == 50.0 and "50 a second, in" in said[-1]


def test_an_unknown_frame_rate_is_assumed_and_said(tracked: Path, tmp_path: Path) -> None:
    subject, said = import_folder(tracked, tracked, tmp_path / "out")
    assert subject.recording.fps == 25.0 and "25 a second (assumed; --fps says otherwise), in" in said[-1]


@pytest.mark.parametrize("fps", ["fast", 0, -30, 1e9, None, [30, 30], True])
def test_a_record_that_is_no_frame_rate_is_said_and_not_used(fps: object, tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap")
    record(folder, fps)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    sentence = f"fps in transforms_train.json is {fps}, which is no frame rate: it is not used; give --fps"
    assert subject.recording.fps == 25.0 and f"note: {sentence}" in said


def test_check_tells_seconds_by_the_frame_rate(tracked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tracked), "--fps", "2", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["facts"]["frames a second"] == "2"
    assert "short-clip" not in {one["check"] for one in report["findings"]}  # 24 frames are 12 seconds
    check = check_tracked_folder(tracked, lambda: load_head_assets(tracked / "head_model"))
    assert check.to_dict()["facts"]["frames a second"] == "25 (assumed)"
    assert any("24 usable frames, 1 seconds at 25 per second" in one.problem for one in check.findings)
