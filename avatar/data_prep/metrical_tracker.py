"""Reading of metrical-tracker's `.frame` files: one frame's FLAME parameters and camera each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data_prep.safe_pickle import UnsafeFileError, load_torch_pickle
from avatar.errors import UserError, refuse
from avatar.types import IDENTITY_6D

ROTATION_TOLERANCE = 1e-2  # float16 and rounding; larger errors are not a rotation
INTRINSICS_NOTE, INTRINSICS_ERROR = 1e-3, 5e-2  # relative change of fx, fy, cx, cy within a clip


@dataclass(frozen=True)
class FrameTrack:
    """One `.frame` file, float64, checked for shape and finiteness."""

    expression: np.ndarray  # [E]
    jaw: np.ndarray  # [6]
    eyes: np.ndarray  # [12]
    eyelids: np.ndarray  # [2]
    R: np.ndarray  # [3, 3], a rotation
    t: np.ndarray  # [3]
    shape: np.ndarray  # [S]
    intrinsics: np.ndarray  # [4] = fx, fy, cx, cy in pixels
    size: tuple[int, int]  # width, height
    frame_id: int | None  # the number that the tracker wrote inside

    def moving_values(self) -> np.ndarray:
        """All that changes from frame to frame, as one vector."""
        return np.concatenate((self.expression, self.jaw, self.eyes, self.eyelids, self.R.ravel(), self.t))


@dataclass(frozen=True)
class Tracking:
    frames: dict[int, FrameTrack]  # usable ones by number, increasing
    bad: dict[int, str]  # why the others are not
    notes: list[str]  # what the user should know
    paths: dict[int, Path]


class _BadFrame(Exception):
    pass


def read_tracking(paths: dict[int, Path], complain: Callable[[str], object] = refuse) -> Tracking:
    """Read every file; damaged, zero and non-finite ones end up in `bad` with the reason.

    Calls `complain`, which raises UserError by default, for a file that holds code, for intrinsics or image sizes that
    change, and for mixed-up files.
    """
    frames: dict[int, FrameTrack] = {}
    bad: dict[int, str] = {}
    for number, path in paths.items():
        try:
            frames[number] = _read_frame(path)
        except _BadFrame as error:
            bad[number] = str(error)
        except UnsafeFileError as error:
            complain(str(error))
            bad[number] = "it holds more than data"
    notes: list[str] = []
    if frames:
        first = next(iter(frames))
        for number, frame in list(frames.items()):
            for field in ("expression", "shape"):
                here, there = len(getattr(frame, field)), len(getattr(frames[first], field))
                if here != there:
                    bad[number] = f"{here} {field} coefficients where {paths[first].name} has {there}"
                    frames.pop(number, None)
        _check_camera(frames, paths, notes, complain)
        _check_frame_ids(frames, paths, notes, complain)
    return Tracking(frames, dict(sorted(bad.items())), notes, paths)


def _read_frame(path: Path) -> FrameTrack:
    try:
        content = load_torch_pickle(path)
    except UnsafeFileError:
        raise
    except UserError as error:
        raise _BadFrame(str(error).removeprefix(f"{path} ")) from None
    flame, opencv = _section(content, "flame"), _section(content, "opencv")
    R = _values(opencv, "opencv.R", 9).reshape(3, 3)
    t = _values(opencv, "opencv.t", 3)
    jaw, eyes = _values(flame, "flame.jaw", 6), _values(flame, "flame.eyes", 12)
    expression = _values(flame, "flame.exp")
    if not R.any() or not (jaw.any() or eyes.any() or expression.any()):
        raise _BadFrame("all zero: the tracker found no face")
    six_d = np.concatenate((jaw, eyes)).reshape(3, 2, 3)
    if (np.linalg.norm(np.cross(six_d[:, 0], six_d[:, 1]), axis=-1) < 1e-6).any():
        raise _BadFrame("flame.jaw or flame.eyes is not a rotation (its two rows are zero or parallel)")
    return FrameTrack(
        expression=expression,
        jaw=jaw,
        eyes=eyes,
        eyelids=_values(flame, "flame.eyelids", 2) if "eyelids" in flame else np.zeros(2),
        R=_rotation(R),
        t=t,
        shape=_values(flame, "flame.shape"),
        intrinsics=_intrinsics(_values(opencv, "opencv.K", 9).reshape(3, 3)),
        size=_size(content),
        frame_id=_frame_id(content.get("frame_id")),
    )


def _section(content: Any, name: str) -> dict[str, Any]:
    if not isinstance(content, dict) or not isinstance(content.get(name), dict):
        raise _BadFrame(f"no '{name}' in it: not a file of metrical-tracker")
    return content[name]


def _values(section: dict[str, Any], name: str, count: int | None = None) -> np.ndarray:
    """The values of `section[...]` as a float64 vector [count]."""
    key = name.split(".")[1]
    if key not in section:
        raise _BadFrame(f"{name} is missing")
    array = np.asarray(section[key])
    if array.dtype.kind not in "iuf":
        raise _BadFrame(f"{name} is not numbers")
    vector = array.astype(np.float64).ravel()
    if count is not None and len(vector) != count:
        raise _BadFrame(f"{name} has {len(vector)} values, not {count}")
    if not np.isfinite(vector).all():
        raise _BadFrame(f"{name} is not finite ({int((~np.isfinite(vector)).sum())} of {len(vector)} values)")
    return vector


def _rotation(R: np.ndarray) -> np.ndarray:
    """The rotation nearest to R; refused when R is further from it than rounding explains."""
    U, _, Vt = np.linalg.svd(R)
    nearest = U @ Vt
    error = float(np.abs(R - nearest).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(nearest) < 0:
        raise _BadFrame(f"opencv.R is not a rotation (determinant {np.linalg.det(R):.3g}, off by {error:.2g})")
    return nearest


def _intrinsics(K: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if fx <= 0 or fy <= 0 or np.abs(K - expected).max() > 1e-4 * fx:
        raise _BadFrame("opencv.K is not of the form [fx 0 cx; 0 fy cy; 0 0 1] with positive focal lengths")
    return np.array([fx, fy, cx, cy])


def _size(content: dict[str, Any]) -> tuple[int, int]:
    size = np.asarray(content.get("img_size", ())).ravel()
    if size.dtype.kind not in "iuf" or len(size) != 2 or not (size >= 1).all() or not (size < 2**16).all():
        raise _BadFrame("img_size is not (width, height)")
    return int(size[0]), int(size[1])


def _frame_id(value: Any) -> int | None:
    text = str(value)
    return int(text) if text.isascii() and text.isdigit() and len(text) < 12 else None


def _check_camera(
    frames: dict[int, FrameTrack], paths: dict[int, Path], notes: list[str], complain: Callable[[str], object]
) -> None:
    first_number, first = next(iter(frames.items()))
    worst, worst_number = 0.0, first_number
    for number, frame in frames.items():
        if frame.size != first.size:
            complain(
                f"{paths[number]} was tracked on {frame.size[0]}x{frame.size[1]} images but {paths[first_number].name} "
                f"on {first.size[0]}x{first.size[1]}; track the whole video at one size"
            )
            break
        change = float(np.abs(frame.intrinsics - first.intrinsics).max() / first.intrinsics[:2].max())
        if change > worst:
            worst, worst_number = change, number
    if worst > INTRINSICS_NOTE:
        both = " and ".join(
            f"{paths[n].name} has fx fy cx cy = {' '.join(f'{v:.2f}' for v in frames[n].intrinsics)}"
            for n in (first_number, worst_number)
        )
        if worst > INTRINSICS_ERROR:
            complain(f"the intrinsics change within the clip: {both}; track it again with one fixed camera")
        else:
            notes.append(f"the intrinsics change a little within the clip ({both}); those of the first frame are used")


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


def neck_identity(count: int) -> np.ndarray:
    """metrical-tracker has no neck: float32 [count, 6] of the identity."""
    return np.tile(np.array(IDENTITY_6D, np.float32), (count, 1))
