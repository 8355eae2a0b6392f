"""What a check says of folders with several cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig_folder import SEQUENCES, write_listings, write_sequence
from tracked_folder import rotation

from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder

TIMES = 20


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("check")
    return write_listings(root / "EMO", {None: write_sequence(root, replace(SEQUENCES[0], times=TIMES))})


def checked(folder: Path, **options: Any) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(folder.parent / "head_model"), **options)


def copied(rig: Path, root: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    shutil.copytree(rig.parent, root)
    listing = root / "EMO" / "transforms.json"
    content = json.loads(listing.read_text())
    for entry in content["frames"]:
        edit(entry)
    listing.write_text(json.dumps(content))
    return root / "EMO"


def found(check: Check, kind: str) -> list[str]:
    return [finding.problem for finding in check.findings if finding.check == kind]


def test_a_rig_that_is_right_has_no_finding(rig: Path) -> None:
    check = checked(rig)
    assert not [finding for finding in check.findings if finding.check.startswith("camera")]
    assert check.clip is not None and len(check.clip.files.images) == TIMES  # of the front camera


def turn(entry: dict[str, Any], degrees: float) -> None:
    if entry["camera_id"] == "12":
        matrix = np.array(entry["transform_matrix"])
        matrix[:3, :3] = rotation(0, np.radians(degrees), 0) @ matrix[:3, :3]
        entry["transform_matrix"] = matrix.tolist()


def test_a_camera_that_is_calibrated_wrongly_is_named(rig: Path, tmp_path: Path) -> None:
    check = checked(copied(rig, tmp_path / "copy", lambda entry: turn(entry, 8.0)))
    (problem,) = found(check, "camera-pose")
    assert "camera 12" in problem and check.status == 2


def test_a_camera_that_moves_is_named(rig: Path, tmp_path: Path) -> None:
    check = checked(copied(rig, tmp_path / "copy", lambda entry: turn(entry, 0.1 * entry["timestep_index"])))
    (problem,) = found(check, "camera-moves")
    assert "camera 12 moves against camera 08" in problem and check.status == 2


def test_a_camera_whose_clock_is_off_is_named(rig: Path, tmp_path: Path) -> None:
    def behind(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == "07":
            number = min(entry["timestep_index"] + 2, TIMES - 1)
            entry["flame_param_path"] = f"flame_param/{number:05d}.npz"
            if entry["timestep_index"] >= TIMES - 2:
                entry["camera_id"] = "spare"

    check = checked(copied(rig, tmp_path / "copy", behind), cameras="08,07,12")
    (problem,) = found(check, "camera-clock")
    assert "the pictures of camera 07 are 2 frames late" in problem


def test_parameters_that_cannot_be_read_are_one_finding(rig: Path, tmp_path: Path) -> None:
    folder = copied(rig, tmp_path / "copy", lambda _: None)
    for path in (folder / "flame_param").iterdir():
        path.write_bytes(path.read_bytes()[:50])
    check = checked(folder)
    (problem,) = found(check, "tracking")
    assert f"cannot be used in {TIMES} frames" in problem and check.status == 2


def test_a_static_offset_of_another_head_is_one_finding(rig: Path, tmp_path: Path) -> None:
    folder = copied(rig, tmp_path / "copy", lambda _: None)
    for path in (folder / "flame_param").iterdir():
        np.savez(path, **np.load(path), static_offset=np.zeros((1, 3, 3), np.float32))
    (problem,) = found(checked(folder), "tracking")
    assert f"{TIMES} frames" in problem and "static_offset in 00000.npz has 3 vertices" in problem


def test_a_pose_that_cannot_be_used_is_found_in_any_camera(rig: Path, tmp_path: Path) -> None:
    def spoil(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == "12":
            entry["transform_matrix"][0][0] = float("nan")

    check = checked(copied(rig, tmp_path / "copy", spoil))
    (problem,) = found(check, "tracking")
    assert "camera 12" in problem and "transform_matrix is not finite" in problem and check.status == 2


def test_pictures_that_are_not_there_do_not_stop_the_check(rig: Path, tmp_path: Path) -> None:
    folder = copied(rig, tmp_path / "copy", lambda _: None)
    for path in (folder / "images").glob("*_0[78].png"):
        path.unlink()
    assert checked(folder).status == 2
