"""`avatar check` on the folders of other programs: clean ones have no finding, a defect has its own."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from check_findings import ALWAYS, new_findings
from exports import write_imavatar, write_insta, write_vhap
from folder_damage import FRAMES
from nha_folder import edit_tracking, write_nha
from tracked_folder import write_tracked_folder

from avatar.cli import main
from avatar.data.split import split_frames
from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder
from data_prep.check.overlay import draw_overlays
from data_prep.check.page import write_frames

WRITERS: dict[str, Callable[..., Path]] = {"VHAP": write_vhap, "INSTA": write_insta, "IMavatar": write_imavatar}
FILES = {  # what is counted, beside the images
    "VHAP": {"images", "fg_masks", "flame_param"},
    "INSTA": {"images", "matted", "seg_mask", "checkpoint"},
    "IMavatar": {"image", "mask", "semantic", "flame_params.json"},
}
NO_LIDS = {"VHAP": {"still-part"}, "IMavatar": {"still-part"}, "INSTA": set()}  # a note that they have no eyelids


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("formats") / "someone", FRAMES, suffix=".png")


@pytest.fixture(scope="module")
def exported(tracked: Path) -> dict[str, Path]:
    return {name: write(tracked, tracked.parent / name) for name, write in WRITERS.items()}


def checked(folder: Path, tracked: Path, **options: Any) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(tracked / "head_model"), **options)


def cut(folder: Path, name: str) -> None:
    path = folder / name
    path.write_bytes(path.read_bytes()[:100])


def black(folder: Path, name: str) -> None:
    image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert cv2.imwrite(str(folder / name), np.zeros_like(image))


def nan_expression(folder: Path, name: str) -> None:
    with np.load(folder / name) as file:
        values = dict(file)
    values["expr"][0, 3] = np.nan
    np.savez(folder / name, **values)


def short_pose(folder: Path, name: str) -> None:
    listing = json.loads((folder / name).read_text())
    listing["frames"][4]["pose"].pop()
    (folder / name).write_text(json.dumps(listing))


DEFECTS: dict[str, tuple[str, Callable[[Path, str], object], str, str, str]] = {
    # defect: format, edit, its file, check, what the sentence must name
    "image": ("VHAP", cut, "images/00004_00.png", "unreadable", "1 of 24 files of images cannot be read"),
    "parameters": ("VHAP", nan_expression, "flame_param/00005.npz", "non-finite", "in frame 00005_00 of flame_param"),
    "matte": ("VHAP", lambda f, n: (f / n).unlink(), "fg_masks/00007_00.png", "missing", "24 images: 00007_00"),
    "result": ("INSTA", lambda f, n: (f / n).unlink(), "checkpoint/00006.frame", "tracking", "frame 00006 of checkpoint"),
    "parsing": ("INSTA", black, "seg_mask/00009.png", "empty-mask", "head mask is empty in frame 00009"),
    "semantic": ("IMavatar", cut, "semantic/12.png", "unreadable", "files of semantic cannot be read"),
    "pose": ("IMavatar", short_pose, "flame_params.json", "tracking", "frame 5 of flame_params.json: pose has 14 values"),
}  # fmt: skip


@pytest.mark.parametrize("format", WRITERS)
def test_a_good_export_has_no_finding(format: str, exported: dict[str, Path], tracked: Path) -> None:
    check = checked(exported[format], tracked)
    assert new_findings(check).keys() == NO_LIDS[format]
    assert check.status == 0 and check.clip is not None
    facts = check.to_dict()["facts"]
    assert facts["format"] == format and facts["frame offset"] == 0
    assert "images and tracking are paired by" in facts["offset found"]
    assert {name.removeprefix("files in ") for name in facts if name.startswith("files in ")} <= FILES[format]
    assert len(check.clip.fits) == FRAMES
    assert min(fit.overlap for fit in check.clip.fits.values()) > 0.9
    assert check.coverage is not None
    own_division = {"VHAP": 6, "INSTA": 6}  # one listing for all frames has none
    usual = len(split_frames(FRAMES).test)
    assert len(check.coverage.split.test) == own_division.get(format, usual)


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_found_and_named_as_the_format_names_it(
    defect: str, exported: dict[str, Path], tracked: Path, tmp_path: Path
) -> None:
    format, edit, file, name, sentence = DEFECTS[defect]
    folder = Path(shutil.copytree(exported[format], tmp_path / "subject"))
    edit(folder, file)
    check = checked(folder, tracked)
    found = {finding.check: finding for finding in check.findings if finding.severity != "note"}
    assert found.keys() == {name}, found
    assert found[name].severity == "warning" and sentence in found[name].problem
    assert len(found[name].frames) == 1 and check.status == 1


def test_what_cannot_be_imported_is_an_error(exported: dict[str, Path], tracked: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(exported["VHAP"], tmp_path / "subject"))
    listing = json.loads((folder / "transforms_train.json").read_text())
    listing["frames"][3]["file_path"] = "../elsewhere.png"
    (folder / "transforms_train.json").write_text(json.dumps(listing))
    check = checked(folder, tracked)
    assert [(one.severity, one.check) for one in check.findings] == [("error", "layout")]
    assert "elsewhere.png" in check.findings[0].problem
    offset = new_findings(checked(exported["VHAP"], tracked, frame_offset=2))
    assert offset.keys() == {"frame-offset"} | NO_LIDS["VHAP"] and "--frame-offset 2" in offset["frame-offset"].problem


def test_the_command_takes_the_format(
    exported: dict[str, Path], tracked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--head", str(tracked / "head_model"), "--json"]
    assert (
        main(["check", str(exported["IMavatar"]), "--data-format", "IMavatar", "--out", str(tmp_path), *options]) == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert {finding["check"] for finding in report["findings"]} <= ALWAYS | NO_LIDS["IMavatar"]
    assert (tmp_path / "index.html").is_file()
    assert main(["check", str(exported["IMavatar"]), "--data-format", "INSTA", *options]) == 2
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["check"] == "layout" and "is not a folder of INSTA's" in finding["problem"]


def test_frames_whose_images_have_one_name_are_told_apart(tmp_path: Path) -> None:
    """All images of NHA are called image_0000.png."""
    count = 12
    folder = write_nha(tmp_path / "person", count)
    edit_tracking(folder, lambda rows: rows.update({k: v[2:] for k, v in rows.items() if len(v) == count}))
    clip = (check := checked(folder, folder)).clip
    assert clip is not None
    (unpaired,) = (finding for finding in check.findings if finding.check == "unpaired")
    assert "frame_0000_image_0000, frame_0001_image_0000" in unpaired.problem
    write_frames(clip, tmp_path / "frames.csv")
    with (tmp_path / "frames.csv").open() as file:
        assert len({row["image"] for row in csv.DictReader(file)}) == count
    assert len({caption.partition(":")[0] for _, caption in draw_overlays(clip)}) == 8
