"""Listings of frames in NeRF's manner (`transforms*.json`, `flame_params.json`), read as data that may be wrong.

A listing is one object with `frames`, a list of objects, and values that all frames share. Numbers that are no numbers
spoil a frame, not the program; a path that leaves the folder is refused, because only somebody who means harm, or who
has moved a part of a larger data set, writes one.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from statistics import median
from typing import Any

import numpy as np

from avatar.data.read_image import IMAGE_SUFFIXES, OTHER_PICTURES
from avatar.data.source import MAX_FPS
from avatar.errors import UserError
from avatar.files import read
from avatar.files.names import natural_order
from data_prep.formats.frame_track import BadFrame, rigid_motion, vector

SPLITS = ("train", "val", "test")
MAX_BYTES = 2**28
MAX_FRAMES = 200_000
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes: y up and z backward become y down and z forward


@dataclass(frozen=True)
class ListedFrame:
    """One entry of `frames`, where it stands, and the values that it shares with the others of its listing."""

    listing: Path
    position: int
    values: dict[str, Any]
    shared: dict[str, Any]
    split: str | None  # "train", "val", "test"; None where the folder has no such division
    root: Path  # the folder that was given

    def numbers(self, key: str, count: int | None = None) -> np.ndarray:
        """The frame's own value, else the shared one, as a float64 vector [count]; BadFrame when there is neither, or not
        that many finite numbers."""
        value = self.values.get(key, self.shared.get(key))
        if value is None:
            raise BadFrame(f"{key} is missing in {self.listing.name}")
        return vector(value, key, count)

    @property
    def image(self) -> Path:
        """The file of `file_path`, which may lack its suffix."""
        path = self.path("file_path")
        if path is None:
            raise UserError(f"{self.listing}: frame {self.position} has no file_path; export the folder again")
        if path.suffix.lower() in (*IMAGE_SUFFIXES, *OTHER_PICTURES):
            return path
        candidates = [path.with_name(path.name + suffix) for suffix in (".png", *IMAGE_SUFFIXES)]
        return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])

    def path(self, key: str) -> Path | None:
        """The file that the entry names, relative to its listing; None where it names none.

        Raises UserError for what is not a path inside the folder.
        """
        value = self.values.get(key)
        if value is None:
            return None
        where = f"{self.listing}: {key} of frame {self.position}"
        if not is_path(value):
            raise UserError(f"{where} is not a path; export the folder again")
        forms = PurePosixPath(value), PureWindowsPath(value)
        if not all(form.parts for form in forms):
            raise UserError(f"{where} is {value!r}, which is a folder, not a file; export the folder again")
        # A UNION set of GaussianAvatars' lists frames of the sequences beside it: ../SEQUENCE/images/00000_00.png
        beside = 1 if is_union(self.listing.parent) and forms[0].parts[0] == ".." and len(forms[0].parts) > 2 else 0
        if any(form.root or form.drive or ".." in form.parts[beside:] for form in forms):
            raise UserError(
                f"{where} is {value!r}, which leaves {self.listing.parent}; give a folder that holds its own frames"
            )
        place = self.listing.parent.parent.joinpath(*forms[0].parts[1:]) if beside else self.listing.parent / value
        if "\\" in value and not os.path.exists(place):  # noqa: PTH110 (Path.exists raises for a name that is too long)
            place = self.listing.parent / forms[1].as_posix()  # written on Windows
        return place


def is_union(folder: Path) -> bool:
    """Whether a folder joins the sequences beside it, as UNION10_306_... of GaussianAvatars' data set does."""
    return folder.name.upper().startswith("UNION")


def is_path(value: Any) -> bool:
    """Whether the value is text that a file system takes as a path: encodable, and no part of it too long."""
    if not isinstance(value, str) or not value or "\0" in value or len(value) > 4096:
        return False
    try:
        return max(len(part.encode()) for part in re.split(r"[/\\]", value)) <= 255
    except UnicodeEncodeError:
        return False


def read_listings(folder: Path) -> list[ListedFrame]:
    """All frames that the folder lists; empty without a listing.

    `transforms_{train,val,test}.json`, or `flame_params.json` in train/, val/ and test/, or one `transforms.json` or
    `flame_params.json` for all. An image that several of them list is a test frame if `test` has it, else a training
    frame if `train` has it. Frames of one folder are in the order of the numbers in their images' names (exporters list
    them as their processes finish), folders in the order of what they are for: training, validation, test.
    Raises UserError for listings that cannot be read and for two frames of one image.
    """
    divided = {
        split: path
        for split in SPLITS
        for path in (folder / f"transforms_{split}.json", folder / split / "flame_params.json")
        if read.is_there(path)
    }
    whole = [path for path in (folder / "transforms.json", folder / "flame_params.json") if read.is_there(path)]
    frames: dict[Path, ListedFrame] = {}
    for split in sorted(divided, key=("val", "train", "test").index):
        frames |= _read_listing(divided[split], split, folder)
    if not frames and whole:
        frames = _read_listing(whole[0], None, folder)
    elif frames and not any(frame.split == "test" for frame in frames.values()):
        held_out = {path for path, frame in frames.items() if frame.split == "val"}
        frames = {path: replace(frame, split="test") if path in held_out else frame for path, frame in frames.items()}
    return _in_order(frames)


def numbered(frames: Sequence[ListedFrame]) -> dict[int, ListedFrame]:
    """The frames by number, from 0, with gaps as in `spaced`."""
    return dict(zip(spaced([frame.image for frame in frames]), frames, strict=True))


def spaced(files: Sequence[Path]) -> list[int]:
    """Numbers of files, from 0. A number is missing between two folders, which are two sequences, and where the numbers in
    the files' names skip more than they usually do."""
    found: list[int] = []
    for _, group in groupby(files, key=lambda file: file.parent):
        names = _name_numbers([file.stem for file in group])
        steps = [after - before for before, after in pairwise(names)]
        usual = median(steps) if steps else 0
        found.append(found[-1] + 2 if found else 0)
        for step in steps:
            found.append(found[-1] + (2 if step > usual else 1))
    return found


def _name_numbers(stems: list[str]) -> list[int]:
    """The number in each name that tells them apart; 0, 1, ... where there is not one such."""
    runs = [re.findall(r"[0-9]+", stem) for stem in stems]
    if len({len(each) for each in runs}) == 1:
        varying = [column for column in zip(*runs, strict=True) if len(set(column)) > 1]
        if len(varying) == 1:
            return [int(digits) for digits in varying[0]]
    return list(range(len(stems)))


def _in_order(frames: dict[Path, ListedFrame]) -> list[ListedFrame]:
    first_use = {folder: len(SPLITS) for folder in {path.parent for path in frames}}
    for path, frame in frames.items():
        if frame.split is not None:
            first_use[path.parent] = min(first_use[path.parent], SPLITS.index(frame.split))
    order = sorted(frames, key=lambda path: (first_use[path.parent], natural_order(str(path))))
    return [frames[path] for path in order]


def _read_listing(file: Path, split: str | None, root: Path) -> dict[Path, ListedFrame]:
    """The listed frames by their image."""
    raw = read_json(file)
    entries = raw.get("frames") if isinstance(raw, dict) else None
    if not isinstance(entries, list) or len(entries) > MAX_FRAMES:
        raise UserError(f"{file} has no list of at most {MAX_FRAMES} frames under 'frames'; export the folder again")
    shared = {key: value for key, value in raw.items() if key != "frames"}
    frames: dict[Path, ListedFrame] = {}
    for position, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise UserError(f"{file}: frame {position} is not an object with values; export the folder again")
        frame = ListedFrame(file, position, entry, shared, split, root)
        key = frame.image
        if key in frames:
            raise UserError(
                f"{file}: frames {frames[key].position} and {position} are both {entry['file_path']}; remove one of them"
            )
        frames[key] = frame
    return frames


def read_json(file: Path) -> Any:
    """Raises UserError when the file is unreadable, larger than a listing can be, or nested like no listing is."""
    try:
        return read.read_json(file, MAX_BYTES)
    except UserError as error:
        raise UserError(f"{error}; copy or export it again") from None


def frame_rate(frames: Sequence[ListedFrame]) -> tuple[float | None, tuple[str, ...]]:
    """Frames a second of the video, where the listing has it under `fps`; and a note where that is no frame rate."""
    given = next((frame for frame in frames if "fps" in frame.shared), None)
    if given is None:
        return None, ()
    try:
        fps = float(given.numbers("fps", 1)[0])
    except BadFrame:
        fps = math.nan
    if 0 < fps <= MAX_FPS:
        return fps, ()
    shown = str(given.shared["fps"])[:40]
    return None, (f"fps in {given.listing.name} is {shown}, which is no frame rate: it is not used; give --fps",)


def camera_pose(frame: ListedFrame) -> tuple[np.ndarray, np.ndarray]:
    """R [3, 3], t [3] from the world to the camera's own axes, out of `transform_matrix`, the camera in the world."""
    R, t = rigid_motion(frame.numbers("transform_matrix", 16).reshape(4, 4), "transform_matrix")
    return R.T, -R.T @ t


def pinhole(frame: ListedFrame, size: tuple[int, int]) -> tuple[np.ndarray, tuple[int, int]]:
    """fx, fy, cx, cy in pixels [4] and the (width, height) that they are for; `size` is that of the images.

    From `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`; without focal lengths from `camera_angle_x` and `camera_angle_y`, without a
    centre the middle.
    """

    def optional(key: str) -> float | None:
        is_given = frame.values.get(key, frame.shared.get(key)) is not None
        return float(frame.numbers(key, 1)[0]) if is_given else None

    def focal_by_angle(key: str, side: float) -> float:
        angle = float(frame.numbers(key, 1)[0])
        if not 0 < angle < math.pi:
            raise BadFrame(f"{key} is {angle:g}, not between 0 and pi")
        return side / (2 * math.tan(angle / 2))

    w, h = optional("w"), optional("h")
    width, height = size[0] if w is None else w, size[1] if h is None else h
    if not (1 <= width < 2**16 and 1 <= height < 2**16):
        raise BadFrame(f"w and h are {width:g} and {height:g}, which no image is")
    fx, fy = optional("fl_x"), optional("fl_y")
    if fx is None:
        fx = focal_by_angle("camera_angle_x", width)
        if fy is None and optional("camera_angle_y") is not None:
            fy = focal_by_angle("camera_angle_y", height)
    fy = fx if fy is None else fy
    cx, cy = optional("cx"), optional("cy")
    if fx <= 0 or fy <= 0:
        raise BadFrame("the focal lengths fl_x and fl_y are not positive")
    centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    return np.array([fx, fy, *centre]), (round(width), round(height))
