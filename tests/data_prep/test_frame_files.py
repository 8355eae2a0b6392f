"""Files by the numbers of their frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from data_prep.formats.frame_files import (
    FrameFiles,
    describe_numbers,
    find_numbered,
    find_shifted_masks,
    gaps,
    transparent,
)


def named(*names: str, first: int = 1) -> FrameFiles:
    return FrameFiles(Path("/a"), {number: Path("/a", name) for number, name in enumerate(names, start=first)})


@pytest.mark.parametrize(
    ("names", "by_names"),
    [
        (("imgs/1.png", "imgs/take_2.png", "imgs/s7_003.png"), True),
        (("imgs/1.png", "imgs/3.png"), False),
        (("imgs/1.png", "imgs/two.png"), False),
        (("one/1.png", "two/2.png"), False),
    ],
)
def test_numbers_in_names_count_where_all_images_have_them_in_one_folder(
    names: tuple[str, ...], by_names: bool
) -> None:
    assert named(*names).is_numbered_by_names == by_names


def test_frames_are_called_as_their_files_and_with_their_folders_where_there_are_several() -> None:
    assert named("imgs/1.png", "imgs/2.jpg").frame_names() == {1: "1", 2: "2"}
    assert named("x/imgs/1.png", "y/imgs/1.png").frame_names() == {1: "x_imgs_1", 2: "y_imgs_1"}


def test_files_are_found_by_the_number_before_their_tag(tmp_path: Path) -> None:
    for name in ("a_10_mouth.PNG", "9_Mouth.jpg", "9_neckhead.png", "notes.txt", ".8_mouth.png", "3.png"):
        (tmp_path / name).touch()
    (tmp_path / "7_mouth.png").mkdir()
    said: list[str] = []
    found = find_numbered(tmp_path, said.append, "_mouth")
    assert [(number, path.name) for number, path in found.items()] == [(9, "9_Mouth.jpg"), (10, "a_10_mouth.PNG")]
    assert said == []
    (tmp_path / "009_mouth.png").touch()
    (tmp_path / "last_mouth.png").touch()
    assert len(find_numbered(tmp_path, said.append, "_mouth")) == 2
    assert ["both frame 9" in said[0], "last_mouth.png has no frame number" in said[1]] == [True, True]


@pytest.mark.parametrize(
    ("masks", "shifted"),
    [((1, 10), False), ((0, 9), True), ((2, 11), True), ((0, 10), False), ((0, 11), False), ((2, 9), False)],
)
def test_masks_that_begin_and_end_earlier_or_later_are_shifted(masks: tuple[int, int], shifted: bool) -> None:
    images = {number: Path(f"{number}.png") for number in range(1, 11)}
    numbers = {number: Path(f"{number}_mouth.png") for number in range(masks[0], masks[1] + 1)}
    said: list[str] = []
    find_shifted_masks(FrameFiles(Path(), images, mouth_masks=numbers), said.append)
    assert len(said) == shifted and all("rename the masks" in line for line in said)
    find_shifted_masks(FrameFiles(Path(), {}, mouth_masks=numbers), said.append)
    assert len(said) == shifted


@pytest.mark.parametrize(("least", "is_matte"), [(254, True), (255, False)])
def test_images_are_mattes_where_one_of_a_few_is_transparent_somewhere(
    least: int, is_matte: bool, tmp_path: Path
) -> None:
    paths = {number: tmp_path / f"{number}.png" for number in range(1, 20)}
    for number, path in paths.items():
        pixels = np.full((4, 4, 4), 255, np.uint8)
        pixels[0, 0, 3] = least if number == 3 else 255
        assert cv2.imwrite(str(path), pixels)
    paths[1].write_bytes(b"damaged")
    assert transparent(paths) == (paths if is_matte else {})
    assert transparent({}) == {}


def test_runs_of_numbers_are_joined_and_long_lists_cut() -> None:
    assert describe_numbers([9, 3, 5, 4]) == "00003-00005, 00009"
    assert describe_numbers([1, 3, 5], limit=2) == "00001, 00003 and 1 more"
    assert describe_numbers([1, 3], limit=2, name={1: "a", 3: "b"}.__getitem__) == "a, b"


def test_gaps_lie_between_the_first_and_the_last_number_and_are_bounded() -> None:
    place = Path("x")
    assert gaps(dict.fromkeys([3, 4, 7], place)) == [5, 6] and gaps(dict.fromkeys([3, 4], place)) == []
    assert gaps({}) == [] and gaps(dict.fromkeys([1, 10**9], place)) == [*range(2, 10_002)]
