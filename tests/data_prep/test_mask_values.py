"""Mattes and masks as other programs write them: labels are understood, what shows no person is refused with a figure."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from preparing import prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.read_image import read_mask
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder
from data_prep.prepare.mask_values import is_coloured

FRAMES = 12
HEADS, MOUTHS, MATTES = "parsing/*_neckhead.png", "parsing/*_mouth.png", "alpha/*.png"
Change = Callable[[np.ndarray, int], np.ndarray]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("good") / "subject", FRAMES, suffix=".png")


@pytest.fixture(scope="module")
def original(good: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return prepare_folder(good, tmp_path_factory.mktemp("prepared") / "out", frame_offset=1)[0]


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "subject"))


def rewrite(folder: Path, pattern: str, change: Change) -> None:
    """Replace each mask, 0 or 255, by `change(mask, position)`."""
    for position, path in enumerate(sorted(folder.glob(pattern))):
        assert cv2.imwrite(str(path), change(read_mask(path), position))


def with_palette(folder: Path, pattern: str, palette: tuple[int, ...], label: int = 1) -> None:
    for path in sorted(folder.glob(pattern)):
        mask = read_mask(path)
        image = Image.frombytes("P", mask.shape[::-1], ((mask > 127) * np.uint8(label)).tobytes())
        image.putpalette([*palette, *([0] * (768 - len(palette)))])
        image.save(path)


def checked(folder: Path) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(folder / "head_model"), frame_offset=1)


def test_a_picture_in_colour_is_told_from_a_mask_by_enough_pixels_whose_values_are_its_luminance() -> None:
    picture = np.full((20, 20, 3), 90, np.uint8)
    picture[:3, 0] = 200, 90, 30
    luminance = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    assert is_coloured(picture, luminance) and is_coloured(picture, luminance + np.uint8(16))
    assert not is_coloured(picture, luminance + np.uint8(17))  # its transparency, or a palette's numbers
    picture[1:3, 0] = 90
    assert not is_coloured(picture, cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))  # 1 of 400 pixels


DAVIS = (0, 0, 0, 128, 0, 0)  # black, dark red: a luminance of 38
BRIGHT = (68, 1, 84, 253, 231, 37)  # a background that is not black
LABELS: dict[str, Callable[[Path, str], None]] = {
    "a palette": lambda f, p: with_palette(f, p, DAVIS),
    "a palette whose background has a colour": lambda f, p: with_palette(f, p, BRIGHT),
    "0 and 1": lambda f, p: rewrite(f, p, lambda m, _: m // 255),
    "0 and 38": lambda f, p: rewrite(f, p, lambda m, _: np.where(m > 0, 38, 0).astype(np.uint8)),
    "0 and 1 in 16 bits": lambda f, p: rewrite(f, p, lambda m, _: (m // 255).astype(np.uint16)),
    "a colour": lambda f, p: rewrite(f, p, lambda m, _: np.dstack((m * 0, m * 0, m // 2))),
}


@pytest.mark.parametrize(
    ("kind", "pattern"), [*((kind, MATTES) for kind in LABELS), ("a palette", HEADS), ("a palette", MOUTHS)]
)
def test_label_images_are_read_as_masks_and_it_is_said(
    kind: str, pattern: str, original: Subject, folder: Path, tmp_path: Path
) -> None:
    LABELS[kind](folder, pattern)
    subject, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    for index in (0, FRAMES - 1):
        mine, theirs = subject.frame(index), original.frame(index)
        assert all(torch.equal(getattr(mine, k), getattr(theirs, k)) for k in ("alpha", "head_mask", "mouth_mask"))
    assert len([line for line in said if "label images" in line and "is read as 255" in line]) == 1
    check = checked(folder)
    assert check.status == 0 and [f.severity for f in check.findings if f.check == "mask-labels"] == ["note"]


def test_a_palette_of_greys_is_no_label_image(folder: Path, tmp_path: Path) -> None:
    with_palette(folder, HEADS, (0, 0, 0, 255, 255, 255))
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert not any("label" in line for line in said)


def test_a_faint_frame_among_soft_mattes_stays_faint(folder: Path, tmp_path: Path) -> None:
    """Two values in one file are no labels where others hold more."""
    faint = np.zeros((64, 64), np.uint8)
    faint[:, :40] = 3
    rewrite(folder, MATTES, lambda m, n: faint if n == 3 else cv2.GaussianBlur(m, (0, 0), 1.0))
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1, max_left_out=0.5, ignore_misfit=True)
    assert subject.frame(3).alpha.max() == pytest.approx(3 / 255)


def labels_that_change(mask: np.ndarray, position: int) -> np.ndarray:
    return np.where(mask > 0, 1 + position % 2, 0).astype(np.uint8)


def cut_out(mask: np.ndarray, _: int) -> np.ndarray:
    return np.dstack([np.where(mask > 0, value, 0).astype(np.uint8) for value in (120, 160, 230)]) + noise(mask)


def noise(mask: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 20, (*mask.shape, 3), np.uint8)


USELESS: dict[str, tuple[str, Change, str]] = {
    # what is wrong: which masks, what becomes of them, what is said
    "labels that change": (MATTES, labels_that_change, r"reach only 2 of 255 \(values 0, 1, 2\)"),
    "class numbers as head masks": (HEADS, lambda m, _: m // 15, r"reach only 17 of 255|label"),
    "faint": (MATTES, lambda m, _: cv2.GaussianBlur(m, (0, 0), 1.0) // 4, r"reach only 63 of 255 \(values 0, 1, 2"),
    "no background": (MATTES, lambda m, _: np.where(m > 0, 255, 99).astype(np.uint8), r"nowhere below 99 of 255"),
    "black": (MATTES, lambda m, _: m * 0, r"are all black: nobody is in them"),
    "black head masks": (HEADS, lambda m, _: m * 0, r"are all black|is empty"),
    "pictures in colour": (MATTES, cut_out, r"is a picture in colour, not one of the mattes"),
    "inverted": (MATTES, lambda m, _: 255 - m, r"are inverted: 0% of the tracked head and 100% of the upper corners"),
    "inverted head masks": (HEADS, lambda m, _: 255 - m, r"the head masks in .* are inverted: 0% of the tracked head"),
    "inverted mouth masks": (MOUTHS, lambda m, _: 255 - m, r"the mouth masks in .* are inverted: 9.% of the picture"),
    "inverted in a part": (MATTES, lambda m, n: 255 - m if n < 4 else m, r"in 4 of 12 sampled frames \(00001-00004\)"),
    "inverted labels": (MATTES, lambda m, _: 1 - m // 255, r"are inverted: 0% of the tracked head"),
    "of something else": (MATTES, lambda m, _: np.roll(m, 40, 1), r"transparent where the head is: \d+% opaque on the"),
}


@pytest.mark.parametrize("name", USELESS)
def test_masks_that_show_no_person_are_refused_with_the_figure(name: str, folder: Path, tmp_path: Path) -> None:
    pattern, change, sentence = USELESS[name]
    rewrite(folder, pattern, change)
    if name == "class numbers as head masks":  # of several classes
        rewrite(folder, pattern, lambda m, _: np.where(np.arange(64)[:, None] < 20, m // 2, m).astype(np.uint8))
    with pytest.raises(UserError, match=sentence):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)
    errors = [finding for finding in checked(folder).findings if finding.severity == "error"]
    assert {finding.check for finding in errors} & {"mask-range", "inverted-mask", "empty-mask"}, errors
    assert not any("head model" in finding.advice for finding in errors)


def test_inverted_mattes_are_refused_where_they_are_the_only_masks(folder: Path, tmp_path: Path) -> None:
    shutil.rmtree(folder / "parsing")
    rewrite(folder, MATTES, lambda m, _: 255 - m)
    with pytest.raises(UserError, match="the mattes in .* are inverted"):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)


def test_an_empty_matte_leaves_its_frame_out(folder: Path, tmp_path: Path) -> None:
    rewrite(folder, MATTES, lambda m, n: m * 0 if n == 4 else m)
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1, max_left_out=0.1)
    assert subject.manifest.left_out == {"00005": "00005.png is empty: no head was found"}
    assert [f.frames for f in checked(folder).findings if f.check == "empty-mask"] == [("00005",)]


def test_masks_that_nearly_reach_white_are_taken_and_it_is_said(folder: Path, tmp_path: Path) -> None:
    limited = (16 + np.arange(256) * 219 / 255).round().astype(np.uint8)  # video's range
    rewrite(folder, MATTES, lambda m, _: limited[cv2.GaussianBlur(m, (0, 0), 1.0)])
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert any("reach only 235 of 255: the avatar will be a little transparent" in line for line in said)
    assert {f.severity for f in checked(folder).findings if f.check == "mask-range"} == {"warning"}


def test_mouth_masks_that_are_all_black_are_taken_and_it_is_said(folder: Path, tmp_path: Path) -> None:
    rewrite(folder, MOUTHS, lambda m, _: m * 0)
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert any("are all black: the mouth gets no weight of its own" in line for line in said)
