"""Tracked folders with something wrong: one sentence each, naming the file or frame and what to do."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tracked_folder import write_head_model, write_tracked_folder

from avatar.data.images import read_mask
from avatar.data.split import SplitSizes
from avatar.data_prep.prepare import prepare
from avatar.errors import UserError
from avatar.head.assets import load_head_assets

FRAMES = 24  # one bad frame is under the 5% limit, two are over it
Edit = Callable[[Path], object]


@pytest.fixture(scope="module")
def good_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("good") / "subject", FRAMES)


def edit_frame(number: int, **changes: Any) -> Edit:
    """Change `section_key` values of one `.frame`; a callable maps the old value to the new, None removes it."""

    def edit(folder: Path) -> None:
        path = folder / "checkpoint" / f"{number:05d}.frame"
        content = torch.load(path, weights_only=False)
        for name, value in changes.items():
            section, _, key = name.partition("__")
            holder, key = (content[section], key) if key else (content, section)
            if value is None:
                del holder[key]
            else:
                holder[key] = value(holder[key]) if callable(value) else value
        torch.save(content, path)

    return edit


def every(edit: Callable[[int], Edit], numbers: range | tuple[int, ...] = range(FRAMES)) -> Edit:
    return lambda folder: [edit(number)(folder) for number in numbers]


def write(pattern: str, data: bytes) -> Edit:
    return lambda folder: [path.write_bytes(data) for path in matching(folder, pattern)]


def cut(pattern: str) -> Edit:
    return lambda folder: [path.write_bytes(path.read_bytes()[:-200]) for path in matching(folder, pattern)]


def remove(pattern: str) -> Edit:
    return lambda folder: [path.unlink() for path in matching(folder, pattern)]


def resize(pattern: str, size: tuple[int, int]) -> Edit:
    def edit(folder: Path) -> None:
        for path in matching(folder, pattern):
            cv2.imwrite(str(path), cv2.resize(read_mask(path), size))

    return edit


def matching(folder: Path, pattern: str) -> list[Path]:
    found = sorted(folder.glob(pattern))
    assert found, pattern
    return found


def swap_frames(folder: Path) -> None:
    a, b = folder / "checkpoint" / "00003.frame", folder / "checkpoint" / "00007.frame"
    a_data = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(a_data)


def freeze(folder: Path) -> None:
    """Nothing moves: every frame is the first."""
    for pattern in ("imgs/*", "alpha/*", "parsing/*_neckhead*", "parsing/*_mouth*"):
        paths = matching(folder, pattern)
        for path in paths[1:]:
            shutil.copy(paths[0], path)
    first = torch.load(folder / "checkpoint" / "00000.frame", weights_only=False)
    for number in range(1, FRAMES):
        torch.save(first | {"frame_id": f"{number:05d}"}, folder / "checkpoint" / f"{number:05d}.frame")


def shift_masks(folder: Path) -> None:
    for path in matching(folder, "parsing/*"):
        cv2.imwrite(str(path), np.roll(read_mask(path), (32, 32), (0, 1)))


def zero_one_masks(folder: Path) -> None:
    for path in matching(folder, "parsing/*_neckhead*"):
        cv2.imwrite(str(path), read_mask(path) // 255)


def all_zero(number: int) -> Edit:
    keys = ("flame__exp", "flame__jaw", "flame__eyes", "flame__eyelids", "opencv__R", "opencv__t")
    return edit_frame(number, **dict.fromkeys(keys, lambda old: old * 0))


def copy_of_previous(number: int) -> Edit:
    def edit(folder: Path) -> None:
        previous = torch.load(folder / "checkpoint" / f"{number - 1:05d}.frame", weights_only=False)
        edit_frame(number, flame=previous["flame"], opencv=previous["opencv"])(folder)

    return edit


def nan_in(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flat[1] = np.nan
    return array


def hostile(folder: Path) -> None:
    (folder / "checkpoint" / "00004.frame").write_bytes(b"cos\nsystem\n(S'touch marker'\ntR.")


def set_K(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda K: K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]], K.dtype)


TWO = (5, 6)
EMPTY_MASK = cv2.imencode(".png", np.zeros((64, 64), np.uint8))[1].tobytes()
CASES: dict[str, tuple[Edit, str]] = {
    # what is there and how it is numbered
    "folder missing": (shutil.rmtree, r"the folder .*subject does not exist"),
    "folder is a file": (
        lambda f: (shutil.rmtree(f), f.write_text("")),
        r"subject is a file; give the folder that holds",
    ),
    "no imgs": (lambda f: shutil.rmtree(f / "imgs"), r"has no frames: put them in .*imgs as 00001\.jpg"),
    "imgs empty": (remove("imgs/*"), r"has no frames: put them in .*imgs as 00001\.jpg"),
    "image without number": (
        lambda f: shutil.copy(f / "imgs/00001.jpg", f / "imgs/cover.jpg"),
        r"imgs/cover\.jpg has no frame number at the end of its name; rename or remove it",
    ),
    "number twice": (
        lambda f: shutil.copy(f / "imgs/00001.jpg", f / "imgs/1.jpg"),
        r"imgs/00001\.jpg and .*imgs/1\.jpg are both frame 1; remove one of them",
    ),
    "number twice, two formats": (
        lambda f: cv2.imwrite(str(f / "imgs/00002.png"), np.zeros((64, 64, 3), np.uint8)),
        r"00002\.jpg and .*00002\.png are both frame 2",
    ),
    "no checkpoint": (
        lambda f: shutil.rmtree(f / "checkpoint"),
        r"checkpoint holds no \.frame files of metrical-tracker; give --tracking",
    ),
    "half of the tracking": (
        remove("checkpoint/0001*.frame"),
        r"10 of 24 images have no partner under offset 1: images are 24 files numbered 00001 to 00024, "
        r"tracking is 14 files numbered 00000 to 00023",
    ),
    "half of the images": (remove("imgs/0001*.jpg"), r"10 of 24 tracking frames have no partner under offset 1"),
    "half of the head masks": (
        remove("parsing/0001*_neckhead.png"),
        r"10 of 24 images cannot be used, more than 5%: 00010-00019 \(it has no head mask\)",
    ),
    "two files swapped": (swap_frames, r"00003\.frame says inside that it is frame 7, while 00000\.frame says 0"),
    # images
    "images cut short": (
        cut("imgs/0000[56].jpg"),
        r"2 of 24 images cannot be used, .*00005\.jpg is cut short; write or",
    ),
    "images empty": (write("imgs/0000[56].jpg", b""), r"imgs/00005\.jpg is empty; write or copy it again"),
    "images are text": (
        write("imgs/0000[56].jpg", b"<html>404</html>"),
        r"imgs/00005\.jpg is neither a JPEG nor a PNG file, whatever its name says",
    ),
    "images damaged": (
        write("imgs/0000[56].jpg", b"\xff\xd8\xff" + b"x" * 80 + b"\xff\xd9"),
        r"imgs/00005\.jpg is damaged and cannot be decoded",
    ),
    "all images damaged": (
        cut("imgs/*.jpg"),
        r"none of the 24 images in .*imgs can be read: .*00001\.jpg is cut short",
    ),
    "PNG cut short": (cut("parsing/0000[56]_neckhead.png"), r"00005_neckhead\.png is cut short"),
    "an image of another size": (
        resize("imgs/00009.jpg", (48, 64)),
        r"imgs/00009\.jpg is 48x64 pixels but 00001\.jpg is 64x64; all frames must have one size",
    ),
    "a mask of another size": (
        resize("parsing/00009_mouth.png", (32, 32)),
        r"00009_mouth\.png is 32x32 pixels but the images are 64x64",
    ),
    "alpha of another size": (
        resize("alpha/*.jpg", (128, 128)),
        r"alpha/00001\.jpg is 128x128 pixels but the images are",
    ),
    "masks of 0 and 1": (zero_one_masks, r"the head mask files in .*parsing hold 0 and 1; multiply them by 255"),
    "head masks empty": (
        write("parsing/0000[56]_neckhead.png", EMPTY_MASK),
        r"00005 \(00005_neckhead\.png is empty: no head was found\)",
    ),
    # tracking
    "tracking hostile": (hostile, r"00004\.frame was not read: it refers to os\.system, which is code"),
    "tracking cut short": (
        cut("checkpoint/0000[56].frame"),
        r"2 of 24 tracking files cannot be used, more than 5%: 00005-00006 \(is damaged or cut short",
    ),
    "tracking empty": (write("checkpoint/0000[56].frame", b""), r"00005-00006 \(is empty; write or copy it again\)"),
    "tracking is text": (
        write("checkpoint/0000[56].frame", b"hello"),
        r"00005-00006 \(is damaged, cut short or not a pick",
    ),
    "tracking is a list": (
        lambda f: [torch.save([1], p) for p in matching(f, "checkpoint/0000[56].frame")],
        r"00005-00006 \(no 'flame' in it: not a file of metrical-tracker\)",
    ),
    "no face": (every(all_zero, (5, 6, 9)), r"3 of 24 .*: 00005-00006, 00009 \(all zero: the tracker found no face\)"),
    "no face anywhere": (every(all_zero), r"24 of 24 tracking files .*all zero: the tracker found no face"),
    "not finite": (
        every(lambda n: edit_frame(n, flame__exp=nan_in), TWO),
        r"00005-00006 \(flame\.exp is not finite \(1 of 10 values\)\)",
    ),
    "translation infinite": (
        every(lambda n: edit_frame(n, opencv__t=lambda t: t * np.inf), TWO),
        r"opencv\.t is not finite",
    ),
    "a section missing": (
        every(lambda n: edit_frame(n, opencv=None), TWO),
        r"no 'opencv' in it: not a file of metrical",
    ),
    "a key missing": (every(lambda n: edit_frame(n, flame__jaw=None), TWO), r"00005-00006 \(flame\.jaw is missing\)"),
    "a value is text": (every(lambda n: edit_frame(n, flame__jaw="open"), TWO), r"flame\.jaw is not numbers"),
    "a value too long": (
        every(lambda n: edit_frame(n, flame__jaw=np.zeros(7)), TWO),
        r"flame\.jaw has 7 values, not 6",
    ),
    "eyes degenerate": (
        every(lambda n: edit_frame(n, flame__eyes=np.ones(12)), TWO),
        r"flame\.jaw or flame\.eyes is not a rotation \(its two rows are zero or parallel\)",
    ),
    "R scaled": (
        every(lambda n: edit_frame(n, opencv__R=lambda R: 2 * R), TWO),
        r"R is not a rotation \(determinant 8",
    ),
    "R a reflection": (
        every(lambda n: edit_frame(n, opencv__R=lambda R: -R), TWO),
        r"R is not a rotation \(determinant -1",
    ),
    "K without focal length": (
        every(lambda n: edit_frame(n, opencv__K=np.eye(3)[None] * 0), TWO),
        r"opencv\.K is not of the form",
    ),
    "K changes": (
        edit_frame(9, opencv__K=set_K(1.2)),
        r"intrinsics change within the clip: 00000\.frame has fx fy cx cy = 179\.20 .* and 00009\.frame has fx",
    ),
    "image size missing": (every(lambda n: edit_frame(n, img_size=None), TWO), r"img_size is not \(width, height\)"),
    "image sizes mixed": (
        edit_frame(9, img_size=np.array([512, 512])),
        r"00009\.frame was tracked on 512x512 images but 00000\.frame on 64x64",
    ),
    "tracked at another size": (
        every(lambda n: edit_frame(n, img_size=np.array([512, 512]))),
        r"the tracking was made on 512x512 images, but those in .*imgs are 64x64; resize the images",
    ),
    "expressions differ": (
        every(lambda n: edit_frame(n, flame__exp=np.ones((1, 9))), TWO),
        r"9 expression coefficients where 00000\.frame has 10",
    ),
    "head model with fewer expressions": (
        every(lambda n: edit_frame(n, flame__exp=np.ones((1, 50)))),
        r"the tracking has 50 expression coefficients but the head model has 10 expression",
    ),
    "identity too long": (
        every(lambda n: edit_frame(n, flame__shape=np.ones((1, 400)))),
        r"the tracking has 400 identity coefficients but the head model has 300 identity directions",
    ),
    "repeated": (
        every(copy_of_previous, (5, 6, 9)),
        r"00006-00007, 00010 \(the tracking repeats that of the frame before, while the image does not\)",
    ),
    "behind the camera": (
        every(lambda n: edit_frame(n, opencv__t=lambda t: -t), TWO),
        r"the tracked head is behind the camera",
    ),
    # offset
    "no masks, and images that do not move": (
        lambda f: (
            shutil.rmtree(f / "parsing"),
            shutil.rmtree(f / "alpha"),
            [shutil.copy(f / "imgs/00001.jpg", p) for p in matching(f, "imgs/*")[1:]],
        ),
        r"the offset between images and tracking is not clear .*and give --frame-offset \(1 where images",
    ),
    "nothing moves": (
        freeze,
        r"the offset between images and tracking is not clear \(best is .*and give --frame-offset",
    ),
    "masks elsewhere": (shift_masks, r"the tracked head does not lie on the masks .*is the tracking of this video"),
    "far too few frames": (
        lambda f: [remove(f"{d}/{n}.*")(f) for d in ("imgs", "checkpoint") for n in ("000[12]*", "0000[5-9]")],
        r"the offset between images and tracking is not clear .*and give --frame-offset",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_folder(name: str, good_folder: Path, tmp_path: Path) -> None:
    edit, sentence = CASES[name]
    folder = tmp_path / "subject"
    shutil.copytree(good_folder, folder)
    head = load_head_assets(folder / "head_model")
    edit(folder)
    with pytest.raises(UserError) as error:
        prepare(folder, head, folder / "head_model", out=tmp_path / "out", say=lambda _: None)
    message = str(error.value)
    assert re.search(sentence, message), message
    assert "\n" not in message
    assert {path.name for path in tmp_path.iterdir()} <= {"subject"}, "a refused folder leaves nothing behind"


OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "tracking folder missing": ({"tracking": "nowhere"}, r"the tracking folder .*nowhere does not exist"),
    "tracking folder empty": ({"tracking": "."}, r"neither .* holds \.frame files"),
    "offset without overlap": (
        {"frame_offset": 500},
        r"no image belongs to a tracking frame under offset 500: images are 24 files numbered 00001",
    ),
    "offset far off": ({"frame_offset": 12}, r"11 of 24 images have no partner under offset 12"),
    "too many test frames": (
        {"split": SplitSizes(test=24)},
        r"24 test frames cannot be held out of 24: choose from 1 to 23",
    ),
    "no test frames": ({"split": SplitSizes(test=0)}, r"0 test frames cannot be held out of 24"),
    "too many training frames": (
        {"split": SplitSizes(train=30)},
        r"30 training frames cannot be taken from 24 with 5 held out",
    ),
    "frame rate of zero": ({"fps": 0.0}, r"fps must be positive, not 0\.0"),
    "frame rate that is none": ({"fps": float("nan")}, r"fps must be positive, not nan"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_bad_options(name: str, good_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options, sentence = OPTIONS[name]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=sentence):
        prepare(good_folder, load_head_assets(good_folder / "head_model"), "", out=tmp_path / "out", say=str, **options)


def test_a_folder_that_is_something_else_is_not_overwritten(good_folder: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"precious exists and is not a prepared subject; choose another --out"):
        prepare(good_folder, load_head_assets(good_folder / "head_model"), "", out=precious, say=str)
    assert (precious / "thesis.tex").read_text() == "years of work"


def test_a_place_that_cannot_be_written(good_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        UserError, match=r"nothing can be written in .*file/sub \(Not a directory\); choose another place"
    ):
        prepare(good_folder, load_head_assets(good_folder / "head_model"), "", out=tmp_path / "file/sub/out", say=str)


def test_another_head_model_is_noticed_by_its_expressions(good_folder: Path, tmp_path: Path) -> None:
    small = write_head_model(tmp_path / "small", expressions=4)
    with pytest.raises(
        UserError, match="has 10 expression coefficients but the head model has 4 expression directions"
    ):
        prepare(good_folder, small, tmp_path / "small", out=tmp_path / "out", say=str)
