"""`avatar check`: every defect is found by its own check and no other, and good folders stay free of findings."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from bad_folders import CASES
from check_findings import new_findings
from folder_damage import FRAMES, Edit, all_zero, copy_of_previous, cut, edit_frame, every, nan_in, remove, set_K
from tracked_folder import write_tracked_folder

from avatar.cli import main
from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder


@pytest.fixture(scope="module")
def good_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("good") / "subject", FRAMES)


@pytest.fixture
def folder(good_folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good_folder, tmp_path / "subject"))


def checked(folder: Path, offset: int | None = 1) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(folder / "head_model"), frame_offset=offset)


def edit_images(pattern: str, change: Callable[[np.ndarray, int], np.ndarray]) -> Edit:
    """Replace images by `change(image, position)`, losslessly where they are PNG."""

    def edit(folder: Path) -> None:
        paths = sorted(folder.glob(pattern))
        assert paths, pattern
        for position, path in enumerate(paths):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            options = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
            cv2.imwrite(str(path), change(image, position), options)

    return edit


def paint(pattern: str, where: tuple[slice, slice], value: int) -> Edit:
    def change(image: np.ndarray, _: int) -> np.ndarray:
        image = image.copy()
        image[where] = value
        return image

    return edit_images(pattern, change)


def both(*edits: Edit) -> Edit:
    return lambda folder: [edit(folder) for edit in edits]


def repeat_every_sixth(folder: Path) -> None:
    for number in range(6, FRAMES + 1, 6):
        for pattern in ("imgs/{}.jpg", "alpha/{}.jpg", "parsing/{}_neckhead.png", "parsing/{}_mouth.png"):
            shutil.copy(folder / pattern.format(f"{number - 1:05d}"), folder / pattern.format(f"{number:05d}"))


def composite_on_white(folder: Path) -> None:
    for path in sorted((folder / "imgs").glob("*.jpg")):
        image = cv2.imread(str(path)).astype(float)
        alpha = cv2.imread(str(folder / "alpha" / path.name), cv2.IMREAD_GRAYSCALE)[..., None] / 255.0
        cv2.imwrite(str(path), image * alpha + 255 * (1 - alpha), [cv2.IMWRITE_JPEG_QUALITY, 98])


def turn(degrees: float) -> Callable[[np.ndarray], np.ndarray]:
    """About the head's vertical axis."""
    about_y = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0].astype(np.float32)
    return lambda R: R @ about_y


def shift(*metres: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: t + np.array(metres, np.float32)


def both_without_alpha(folder: Path) -> None:
    """Without matte and head mask the whole image counts as the head; with a head mask that covers it all, too."""
    shutil.rmtree(folder / "alpha")
    paint("parsing/*_neckhead.png", np.s_[:, :], 255)(folder)


DEFECTS: dict[str, tuple[Edit, str, str, str]] = {
    # defect: edit, severity, check, what the sentence must name
    "image cut short": (cut("imgs/00004.jpg"), "warning", "unreadable", "00004.jpg is cut short"),
    "two images cut short": (
        both(cut("imgs/00004.jpg"), cut("imgs/00009.jpg")),
        "error",
        "unreadable",
        "2 of 24 files of imgs cannot be read",
    ),
    "mask missing": (remove("parsing/00007_neckhead.png"), "warning", "missing", "1 of 24 images: 00007"),
    "mask without image": (
        lambda f: shutil.copy(f / "alpha/00003.jpg", f / "alpha/00099.jpg"),
        "note",
        "extra",
        "alpha has files without an image: 00099",
    ),
    "stranger": (lambda f: (f / "imgs/notes.txt").write_text("x"), "note", "extra", "imgs/notes.txt"),
    "image missing at the end": (
        lambda f: [p.unlink() for p in f.glob("*/00024*") if p.suffix != ".frame"],
        "note",
        "unpaired",
        "1 tracking frames have no image under the offset 1: 00023.frame",
    ),
    "tracking missing inside": (remove("checkpoint/00011.frame"), "warning", "unpaired", "00012.jpg"),
    "no face": (all_zero(5), "warning", "no-face", "frame 00005"),
    "tracking repeats": (copy_of_previous(9), "warning", "tracking-repeats", "frame 00010"),
    "not finite": (
        edit_frame(6, flame__exp=nan_in, opencv__t=nan_in),
        "warning",
        "non-finite",
        "flame.exp (1 of 10 values), opencv.t (1 of 3 values) in 00006.frame",
    ),
    "head behind the camera": (edit_frame(8, opencv__t=lambda t: -t), "warning", "behind-camera", "00009"),
    "rotation jumps": (
        edit_frame(12, opencv__R=turn(150)),
        "warning",
        "jumps",
        "rotation jumps at 3 frames (00012-00014): 00013 lies",
    ),
    "expression jumps": (
        edit_frame(12, flame__exp=lambda e: e + np.eye(10, dtype=np.float32)[9] * 60),
        "warning",
        "jumps",
        "expression jumps at",
    ),
    "position jumps far": (
        edit_frame(12, opencv__t=lambda t: t + np.full_like(t, 1e15)),
        "warning",
        "jumps",
        "from half-way between its neighbours",
    ),
    "wide focal length": (every(lambda n: edit_frame(n, opencv__K=set_K(0.1))), "warning", "focal-length", "degrees"),
    "pixels not square": (
        every(lambda n: edit_frame(n, opencv__K=lambda K: K * np.array([[1.05, 1, 1], [1, 1, 1], [1, 1, 1]], "f4"))),
        "warning",
        "focal-length",
        "differ by 5%",
    ),
    "principal point outside": (
        every(lambda n: edit_frame(n, opencv__K=lambda K: K + np.array([[0, 0, 40], [0, 0, 0], [0, 0, 0]], "f4"))),
        "warning",
        "principal-point",
        "(72.0, 32.0) is 62%",
    ),
    "lips away": (
        edit_images("parsing/*_mouth.png", lambda m, i: np.roll(m, 5 if i == 10 else 0, axis=0)),
        "warning",
        "residual",
        "lips are away from the mouth mask in frame 00011",
    ),
    "head sticks out": (
        paint("parsing/00011_neckhead.png", np.s_[:, :24], 0),
        "warning",
        "residual",
        "sticks out of the head mask in frame 00011",
    ),
    "repeated images": (
        repeat_every_sixth,
        "warning",
        "repeated-images",
        "4 frames (00006, 00012, 00018, 00024), every 6th",
    ),
    "composited on white": (composite_on_white, "warning", "composited", "composited on white already"),
    "speck in the mask": (
        both(paint("parsing/00009_neckhead.png", np.s_[:6, :8], 255), paint("alpha/00009.jpg", np.s_[:6, :8], 255)),
        "warning",
        "background-leak",
        "pieces apart from the person",
    ),
    "hole in the matte": (paint("alpha/00009.jpg", np.s_[28:36, 28:36], 0), "warning", "matte-holes", "frame 00009"),
    "empty head mask": (paint("parsing/00009_neckhead.png", np.s_[:, :], 0), "warning", "empty-mask", "frame 00009"),
    "exposure": (
        edit_images("imgs/*.jpg", lambda image, i: (image * (0.7 if i > FRAMES // 2 else 1.0)).astype(np.uint8)),
        "warning",
        "exposure",
        "head and background together",
    ),
}
MISFIT = {"residual": "warning"}
CUT_OFF = {"cut-off": "warning"}
ALSO: dict[str, dict[str, str]] = {  # what a defect shows besides, truthfully
    "tracking repeats": MISFIT,
    "head behind the camera": {"jumps": "warning"},
    "rotation jumps": MISFIT,
    "wide focal length": {"residual": "error"},
    "pixels not square": MISFIT,
    "principal point outside": {"residual": "error"} | CUT_OFF,
    "position jumps far": CUT_OFF,
    "speck in the mask": {"cut-off": "note"},
    "head sticks out": {"mask-area": "warning"},
    "repeated images": MISFIT,
}


def test_a_good_folder_has_no_finding(good_folder: Path) -> None:
    check = checked(good_folder, offset=None)
    assert new_findings(check) == {}
    assert check.status == 0
    assert check.clip is not None and check.clip.offset == 1
    given = new_findings(checked(good_folder, offset=2))["frame-offset"]
    assert given.severity == "warning" and "2 is used, but the frames fit image offset 1" in given.problem


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_found_by_its_check_and_named(defect: str, folder: Path) -> None:
    edit, severity, name, sentence = DEFECTS[defect]
    edit(folder)
    check = checked(folder)
    found = new_findings(check)
    assert name in found, found
    same = [finding for finding in check.findings if finding.check == name]
    assert any(sentence in finding.problem and finding.severity == severity for finding in same), same
    expected = {name: severity} | ALSO.get(defect, {})
    assert {found_name: finding.severity for found_name, finding in found.items()} == expected
    assert all(finding.advice and finding.problem for finding in check.findings)
    assert check.status == max({"note": 0, "warning": 1, "error": 2}[one] for one in expected.values())


def test_no_figure_has_more_digits_than_one_can_read(folder: Path) -> None:
    DEFECTS["position jumps far"][0](folder)
    problems = [finding.problem for finding in checked(folder).findings]
    assert any("e+" in problem for problem in problems)
    assert not any(re.search(r"\d{7}", problem) for problem in problems), problems


@pytest.mark.parametrize("case", CASES)
def test_what_prepare_refuses_is_an_error_and_nothing_stops_the_check(case: str, folder: Path) -> None:
    """Every folder that `prepare` refuses, for one reason each, is checked to the end with status 2."""
    CASES[case][0](folder)
    check = checked(folder, offset=None)
    errors = {finding.check for finding in check.findings if finding.severity == "error"}
    assert check.status == 2 and errors and ("left-out" not in errors or len(errors) == 1)  # small losses apart


def test_a_number_that_training_refuses_is_an_error(good_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("--fps=-5", "--fps=nan", "--max-left-out=-1", "--max-left-out=2"):
        assert main(["check", str(good_folder), "--frame-offset", "1", word, "--json"]) == 2
        (only,) = json.loads(capsys.readouterr().out)["findings"]
        assert only["problem"].startswith(f"{word.partition('=')[0]} must be ")


def test_all_defects_are_reported_together(folder: Path) -> None:
    for defect in ("stranger", "no face", "mask missing", "composited on white", "hole in the matte"):
        DEFECTS[defect][0](folder)
    (folder / "imgs" / "cover.jpg").write_bytes(b"")
    check = checked(folder)
    names = {finding.check for finding in check.findings}
    assert names >= {"extra", "no-face", "missing", "composited", "matte-holes", "layout"}
    assert [finding.severity for finding in check.findings] == sorted(
        (finding.severity for finding in check.findings), key=("error", "warning", "note").index
    )


def test_small_losses_add_up_to_an_error(folder: Path) -> None:
    for defect in ("no face", "mask missing"):
        DEFECTS[defect][0](folder)
    check = checked(folder)
    assert new_findings(check)["left-out"].severity == "error"
    assert new_findings(check)["left-out"].frames == ("00006", "00007")


def test_frames_dropped_on_one_side_are_seen_by_the_offset_of_both_ends(tmp_path: Path) -> None:
    """Each third needs 60 frames of its own, more than the other tests have."""
    folder = write_tracked_folder(tmp_path / "subject", 190, size=48)
    tracked = sorted((folder / "checkpoint").iterdir())
    for dropped, path in pairwise(tracked[95:]):
        content = torch.load(path, weights_only=False)
        torch.save(content | {"frame_id": dropped.stem}, dropped)
    tracked[-1].unlink()
    dropped_frames = new_findings(checked(folder))["dropped-frames"]
    assert dropped_frames.severity == "error"
    assert "offset is 1 in the first third of the clip and 2 in the last" in dropped_frames.problem


def test_json_is_all_of_stdout_and_the_status_is_that_of_the_findings(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    all_zero(5)(folder)
    assert main(["check", str(folder), "--frame-offset", "1", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["exit_status"] == 1 and report["facts"]["frame offset"] == 1 and "field of view" in report["facts"]
    assert {"severity": "warning", "check": "no-face"}.items() <= report["findings"][0].items()
    assert main(["check", str(folder / "nowhere"), "--json"]) == 2
    (only,) = json.loads(capsys.readouterr().out)["findings"]
    assert only["severity"] == "error" and "nowhere" in only["problem"]
