"""What a check says of folders with several cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_rig_folder import SEQUENCES, opened, write_listings, write_sequence
from tracked_folder import rotation

from avatar.errors import UserError
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
    assert not found(check, "format")  # all cameras are used


def test_the_cameras_that_are_used_are_those_that_were_named(rig: Path) -> None:
    (said,) = found(checked(rig, cameras="07,12"), "format")
    assert "of the folder's 3 cameras 07, 12 are used" in said


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


@pytest.mark.parametrize(("camera", "check"), [("07", "camera"), ("08", "tracking")])
def test_a_lens_that_changes_is_an_error_by_whichever_camera(
    camera: str, check: str, rig: Path, tmp_path: Path
) -> None:
    def zoom(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == camera and entry["timestep_index"] == 3:
            entry["fl_x"] *= 1.2

    folder = copied(rig, tmp_path / "copy", zoom)
    (problem,) = (finding.problem for finding in checked(folder).findings if finding.severity == "error")
    assert found(checked(folder), check) == [problem] and "with 00003.npz" in problem
    with pytest.raises(UserError, match=f"the intrinsics of camera {camera} change"):
        opened(folder, tmp_path / "out")


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


@pytest.mark.parametrize("is_ignored", [False, True])
def test_ignore_misfit_makes_a_warning_of_what_training_then_goes_on_with(
    rig: Path, tmp_path: Path, is_ignored: bool
) -> None:
    turned = copied(rig, tmp_path / "turned", lambda entry: turn(entry, 8.0))
    inverted = copied(rig, tmp_path / "inverted", lambda _: None)
    edit_files(inverted / "fg_masks", "*", lambda pixels: 255 - pixels)
    for folder, kind in ((turned, "camera-pose"), (inverted, "inverted-mask")):
        check = checked(folder, ignore_misfit=is_ignored)
        assert found(check, kind) and check.status == (1 if is_ignored else 2)
        assert not is_ignored or opened(folder, tmp_path / f"{kind}.out", ignore_misfit=True)


def edit_files(folder: Path, names: str, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    for path in folder.glob(f"{names}.png"):
        assert cv2.imwrite(str(path), edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def test_masks_that_are_label_images_tell_of_a_pose_too(rig: Path, tmp_path: Path) -> None:
    folder = copied(rig, tmp_path / "copy", lambda entry: turn(entry, 8.0))
    edit_files(folder / "fg_masks", "*", lambda pixels: pixels // 255)
    (problem,) = found(checked(folder), "camera-pose")
    assert "camera 12" in problem


def halved(pixels: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(pixels[::2, ::2])


OF_ANOTHER_CAMERA: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "black": (
        lambda f: edit_files(f / "images", "*_12", np.zeros_like),
        "camera-dark",
        "the pictures of camera 12 are",
    ),
    "one size": (
        lambda f: edit_files(f / "images", "*3_12", halved),
        "camera",
        "all frames of a camera must have one size",
    ),
    "sizes": (lambda f: edit_files(f / "images", "*_12", halved), "camera", "make the masks at the size of the images"),
    "tracked size": (
        lambda f: (edit_files(f / "images", "*_12", halved), edit_files(f / "fg_masks", "*_12", halved), None)[-1],
        "camera",
        "the tracking was made on 64x56 images",
    ),
    "damaged": (
        lambda f: [path.write_bytes(b"x") for path in (f / "images").glob("0001*_12.png")].clear(),
        "unreadable",
        "of camera 12 cannot be used in 10 frames (00010_12, ",
    ),
    "masks of the front alone": (
        lambda f: [path.unlink() for name in ("07", "12") for path in (f / "fg_masks").glob(f"*_{name}.png")].clear(),
        "unreadable",
        "of camera 12 cannot be used in 20 frames",
    ),
    "masks of the others alone": (
        lambda f: [path.unlink() for path in (f / "fg_masks").glob("*_08.png")].clear(),
        "unreadable",
        "of camera 08 cannot be used in 20 frames",
    ),
    "no masks": (
        lambda f: [path.unlink() for path in (f / "fg_masks").glob("0001*_12.png")].clear(),
        "unreadable",
        "of camera 12 cannot be used in 10 frames (00010_12, ",
    ),
}


@pytest.mark.parametrize("what", OF_ANOTHER_CAMERA)
def test_what_training_refuses_of_any_camera_is_an_error(rig: Path, tmp_path: Path, what: str) -> None:
    damage, kind, sentence = OF_ANOTHER_CAMERA[what]
    folder = copied(rig, tmp_path / "copy", lambda _: None)
    damage(folder)
    check = checked(folder)
    assert any(sentence in problem for problem in found(check, kind)) and check.status == 2
    with pytest.raises(UserError):
        opened(folder, tmp_path / "out")
    assert "alone" in what or checked(folder, cameras="07,08").status < 2


def test_what_one_camera_loses_is_a_share_of_all_pictures(rig: Path, tmp_path: Path) -> None:
    """Two of twenty in front, and none of forty beside: fewer than training refuses."""
    folder = copied(rig, tmp_path / "copy", lambda _: None)
    for path in sorted((folder / "images").glob("*_08.png"))[3:5]:
        path.write_bytes(b"x")
    check = checked(folder)
    assert [finding.severity for finding in check.findings if finding.check == "unreadable"] == ["warning"]
    assert check.status == 1
    assert opened(folder, tmp_path / "out")
    for path in sorted((folder / "images").glob("*_07.png"))[7:9]:
        path.write_bytes(b"x")
    together = {f.severity for f in checked(folder).findings if "camera 07" in f.problem}
    assert together == {"error"}  # four of sixty
    for path in sorted((folder / "images").glob("*_07.png"))[7:9]:
        shutil.copy(rig / "images" / path.name, path)
    assert checked(folder, cameras="front").status == 2
    with pytest.raises(UserError):
        opened(folder, tmp_path / "front", cameras="front")
    for path in (folder / "flame_param").glob("0000[01].npz"):
        path.write_bytes(b"x")
    assert checked(folder).status == 2
    with pytest.raises(UserError):
        opened(folder, tmp_path / "times")


def test_several_cameras_see_the_sides_of_a_head_that_hardly_turns(tmp_path: Path) -> None:
    folder = write_listings(tmp_path / "EMO", {None: write_sequence(tmp_path, SEQUENCES[0])})
    assert found(checked(folder, cameras="front"), "narrow-views") and not found(checked(folder), "narrow-views")
