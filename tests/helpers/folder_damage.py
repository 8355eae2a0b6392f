"""Ways in which a tracked folder of FRAMES frames can be damaged."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from avatar.data.read_image import read_mask

FRAMES = 24  # one bad frame is under the 5% limit, two are over it
Edit = Callable[[Path], object]


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


def masks_of_three_labels(folder: Path) -> None:
    for path in matching(folder, "parsing/*_neckhead*"):
        labels = read_mask(path) // 255
        labels[:20] *= 2
        cv2.imwrite(str(path), labels)


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


def move_centre(pixels: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda K: K + np.array([[0, 0, pixels], [0, 0, pixels], [0, 0, 0]], K.dtype)


def renumbered(kind: str, number: int) -> Edit:
    """The files of image `number` get the number before it."""

    def edit(folder: Path) -> None:
        for path in matching(folder, f"{kind}/{number:05d}*"):
            path.rename(path.with_name(path.name.replace(f"{number:05d}", f"{number - 1:05d}")))

    return edit
