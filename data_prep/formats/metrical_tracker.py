"""Reading of metrical-tracker's `.frame` files: one frame's FLAME parameters and camera each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError, refuse
from avatar.files.pickles import UnsafeFileError, load_torch_pickle
from avatar.types import IDENTITY_6D
from data_prep.formats.frame_track import (
    BadFrame,
    FrameTrack,
    Tracking,
    nearest_rotation,
    pinhole_of,
    read_frames,
    vector,
)


def read_tracking(
    paths: dict[int, Path], complain: Callable[[str], object] = refuse, named_by_number: bool = True
) -> Tracking:
    """Read every file; damaged, zero and non-finite ones end up in `bad` with the reason.

    Calls `complain`, which raises UserError by default, for a file that holds code, for intrinsics or image sizes that
    change, and, where the files are named by their numbers, for mixed-up files.
    """
    tracking = read_frames(paths, lambda path: _read_frame(path, complain), paths, complain)
    if named_by_number:
        _check_frame_ids(tracking.frames, paths, tracking.notes, complain)
    return tracking


def _read_frame(path: Path, complain: Callable[[str], object]) -> FrameTrack:
    try:
        content = load_torch_pickle(path)
    except UnsafeFileError as error:
        complain(str(error))
        raise BadFrame("it holds more than data") from None
    except UserError as error:
        raise BadFrame(str(error).removeprefix(f"{path} ")) from None
    flame, opencv = _section(content, "flame"), _section(content, "opencv")
    R = _values(opencv, "opencv.R", 9).reshape(3, 3)
    t = _values(opencv, "opencv.t", 3)
    jaw, eyes = _values(flame, "flame.jaw", 6), _values(flame, "flame.eyes", 12)
    expression = _values(flame, "flame.exp")
    if not R.any() or not (jaw.any() or eyes.any() or expression.any()):
        raise BadFrame("all zero: the tracker found no face")
    six_d = np.concatenate((jaw, eyes)).reshape(3, 2, 3)
    if (np.linalg.norm(np.cross(six_d[:, 0], six_d[:, 1]), axis=-1) < 1e-6).any():
        raise BadFrame("flame.jaw or flame.eyes is not a rotation (its two rows are zero or parallel)")
    return FrameTrack(
        expression=expression,
        jaw=jaw,
        eyes=eyes,
        eyelids=_values(flame, "flame.eyelids", 2) if "eyelids" in flame else np.zeros(2),
        neck=np.array(IDENTITY_6D),  # the tracker has no neck
        R=nearest_rotation(R, "opencv.R"),
        t=t,
        shape=_values(flame, "flame.shape"),
        intrinsics=pinhole_of(_values(opencv, "opencv.K", 9).reshape(3, 3), "opencv.K is"),
        size=_size(content),
        frame_id=_frame_id(content.get("frame_id")),
    )


def _section(content: Any, name: str) -> dict[str, Any]:
    if not isinstance(content, dict) or not isinstance(content.get(name), dict):
        raise BadFrame(f"no '{name}' in it: not a file of metrical-tracker")
    return content[name]


def _values(section: dict[str, Any], name: str, count: int | None = None) -> np.ndarray:
    """The values of `section[...]` as a float64 vector [count]."""
    key = name.split(".")[1]
    if key not in section:
        raise BadFrame(f"{name} is missing")
    return vector(section[key], name, count)


def _size(content: dict[str, Any]) -> tuple[int, int]:
    size = np.asarray(content.get("img_size", ())).ravel()
    if size.dtype.kind not in "iuf" or len(size) != 2 or not (size >= 1).all() or not (size < 2**16).all():
        raise BadFrame("img_size is not (width, height)")
    return int(size[0]), int(size[1])


def _frame_id(value: Any) -> int | None:
    text = str(value)
    return int(text) if text.isascii() and text.isdigit() and len(text) < 12 else None


def _check_frame_ids(
    frames: dict[int, FrameTrack], paths: dict[int, Path], notes: list[str], complain: Callable[[str], object]
) -> None:
    """The tracker's own number must agree with the file name, up to one shift of the whole clip."""
    shifts = {number: frame.frame_id - number for number, frame in frames.items() if frame.frame_id is not None}
    if not shifts:
        return
    first_number, usual = next(iter(shifts.items()))
    for number, shift in shifts.items():
        if shift != usual:
            complain(
                f"{paths[number]} says inside that it is frame {number + shift}, while {paths[first_number].name} says "
                f"{first_number + usual}: files were renamed or mixed up; copy the tracker's output again"
            )
            return
    if usual:
        notes.append(f"the .frame files were renumbered: {paths[first_number].name} says it is {first_number + usual}")
