"""What every importer makes of its files: one `FrameTrack` per frame, checked, in the conventions of `avatar.types`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from avatar.errors import UserError, refuse
from avatar.head.assets import IDENTITY_COEFFICIENTS, HeadAssets
from data_prep.formats.identity import MAX_CHANGE, compare_identities

ROTATION_TOLERANCE = 1e-2  # float16 and rounding; larger errors are not a rotation
Item = TypeVar("Item")
FOCAL_ERROR = 5e-2  # relative change of fx and fy within a clip
CENTRE_ERROR = 1e-2  # of the picture's sides, change of cx and cy: by so much the head is elsewhere in the picture
INTRINSICS_NOTE = 0.02  # of these


@dataclass(frozen=True)
class FrameTrack:
    """One frame's tracking, float64, checked for shape and finiteness; R and t are the pose of the head, neck included."""

    expression: np.ndarray  # [E]
    jaw: np.ndarray  # [6]
    eyes: np.ndarray  # [12]
    eyelids: np.ndarray  # [2]
    neck: np.ndarray  # [6], by which the head is turned against the torso
    R: np.ndarray  # [3, 3], a rotation
    t: np.ndarray  # [3]
    shape: np.ndarray  # [S]
    intrinsics: np.ndarray  # [4] = fx, fy, cx, cy in pixels
    size: tuple[int, int]  # width, height
    frame_id: int | None = None  # the number that the tracker wrote inside

    def moving_values(self) -> np.ndarray:
        """All that changes from frame to frame, as one vector."""
        return np.concatenate((self.expression, self.jaw, self.eyes, self.eyelids, self.neck, self.R.ravel(), self.t))


@dataclass(frozen=True)
class Tracking:
    frames: dict[int, FrameTrack]  # usable ones by number, increasing
    bad: dict[int, str]  # why the others are not
    notes: list[str]  # what the user should know
    paths: dict[int, Path]
    flaws: list[str] = field(default_factory=list)  # what was evened out, and should not have been there


class BadFrame(Exception):
    """One frame cannot be used, and why; the others may be fine."""


def read_frames(
    items: Mapping[int, Item],
    read: Callable[[Item], FrameTrack],
    paths: dict[int, Path],
    complain: Callable[[str], object] = refuse,
    cameras: Mapping[int, str] | None = None,
) -> Tracking:
    """`read` what each frame is made of. BadFrames, and frames with another number of coefficients, end up in `bad`;
    `complain` of a camera that changes.

    cameras  which camera each frame is of, where there are several
    """
    frames: dict[int, FrameTrack] = {}
    bad: dict[int, str] = {}
    flaws: list[str] = []
    for number, item in items.items():
        try:
            frames[number] = read(item)
        except BadFrame as error:
            bad[number] = str(error)
    if frames:
        first = next(iter(frames))
        for number, frame in list(frames.items()):
            for field in ("expression", "shape"):
                here, there = len(getattr(frame, field)), len(getattr(frames[first], field))
                if here != there:
                    bad[number] = f"{here} {field} coefficients where {paths[first].name} has {there}"
                    frames.pop(number, None)
        of_camera: dict[str, dict[int, FrameTrack]] = {}
        for number, frame in frames.items():
            of_camera.setdefault("" if cameras is None else cameras[number], {})[number] = frame
        for camera, own in of_camera.items():
            _check_camera(own, paths, flaws, complain, f" of camera {camera}" if camera else "")
            lens = next(iter(own.values())).intrinsics
            frames |= {number: replace(frame, intrinsics=lens) for number, frame in own.items()}
        frames = dict(sorted(frames.items()))
    return Tracking(frames, dict(sorted(bad.items())), [], paths, flaws)


def fit_coefficients(tracking: Tracking, head: HeadAssets, complain: Callable[[str], object] = refuse) -> Tracking:
    """The same tracking with as many coefficients as the head model has directions, and one identity, the frames' median.

    Missing coefficients are zero, further ones are cut where they are zero. Raises UserError where they are not. Calls
    `complain` where the identity changes too much from frame to frame; single frames with another one end up in `bad`.
    """
    notes, flaws, bad = list(tracking.notes), list(tracking.flaws), dict(tracking.bad)
    rows = list(tracking.frames.values())
    expression = _fitted(np.stack([t.expression for t in rows]), head.num_expressions, "expression", notes)
    identities = compare_identities(
        _fitted(np.stack([t.shape for t in rows]), IDENTITY_COEFFICIENTS, "identity", notes), head
    )
    frames = {
        number: replace(track, expression=row, shape=identities.median)
        for (number, track), row in zip(tracking.frames.items(), expression, strict=True)
    }
    if identities.are_many:
        complain(f"{identities.sentence()}; let the tracker find one identity for the whole clip, and track it again")
    elif not identities.are_same:
        flaws.append(f"{identities.sentence()}: the median is used")
        for number, change in zip(tracking.frames, identities.change, strict=True):
            if change > MAX_CHANGE:
                bad[number] = f"its identity is more than {1e3 * MAX_CHANGE:g} mm off the clip's"
                del frames[number]
    return replace(tracking, frames=frames, bad=dict(sorted(bad.items())), notes=notes, flaws=flaws)


def _fitted(values: np.ndarray, count: int, what: str, notes: list[str]) -> np.ndarray:
    have = values.shape[1]
    if values[:, count:].any():
        raise UserError(
            f"the tracking has {have} {what} coefficients but the head model has {count} {what} directions; give --head "
            "the model that the tracking was made with"
        )
    if have != count:
        rest = "the missing ones are zero" if have < count else "the others are zero and left out"
        notes.append(f"the tracking has {have} {what} coefficients, the head model {count}; {rest}")
    return np.pad(values[:, :count], ((0, 0), (0, max(0, count - have))))


def vector(value: Any, name: str, count: int | None = None) -> np.ndarray:
    """`value` as a float64 vector [count]. Raises BadFrame with `name` when it is not that many numbers that are finite in
    float32, in which tracks are kept."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        raise BadFrame(f"{name} is not numbers") from None
    if array.dtype.kind not in "iuf":
        raise BadFrame(f"{name} is not numbers")
    with np.errstate(invalid="ignore", over="ignore"):  # refused below, and needs no warning before that
        values = array.astype(np.float64).ravel()
    if count is not None and len(values) != count:
        raise BadFrame(f"{name} has {len(values)} values, not {count}")
    is_finite = np.abs(values) <= np.finfo(np.float32).max
    if not is_finite.all():
        raise BadFrame(f"{name} is not finite ({int((~is_finite).sum())} of {len(values)} values)")
    return values


def rows_of(values: np.ndarray, name: str, count: int, width: int | None) -> np.ndarray:
    """The values [count, width], a row for each frame, of whatever further axes. Raises BadFrame for another number; None:
    any width."""
    if values.ndim < 2 or len(values) != count or not values.size or width not in (None, values[0].size):
        expected = "some" if width is None else width
        raise BadFrame(f"{name} has the shape {list(values.shape)}, not {expected} values for each of {count} frames")
    return values.reshape(count, -1)


def rigid_motion(matrix: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The rotation [3, 3] and translation [3] of a matrix [4, 4]. Raises BadFrame where it is none."""
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise BadFrame(f"the last row of {name} is not 0 0 0 1")
    return nearest_rotation(matrix[:3, :3], name), matrix[:3, 3]


def pinhole_of(K: np.ndarray, name: str) -> np.ndarray:
    """fx, fy, cx, cy [4] of a matrix [3, 3]. Raises BadFrame, which begins with `name`, where it has another form."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if fx <= 0 or fy <= 0 or np.abs(K - [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).max() > 1e-4 * fx:
        raise BadFrame(f"{name} not of the form [fx 0 cx; 0 fy cy; 0 0 1] with positive focal lengths")
    return np.array([fx, fy, cx, cy])


def nearest_rotation(R: np.ndarray, name: str) -> np.ndarray:
    """The rotation nearest to R; refused when R is further from it than rounding explains."""
    U, _, Vt = np.linalg.svd(R)
    nearest = U @ Vt
    error = float(np.abs(R - nearest).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(nearest) < 0:
        raise BadFrame(f"{name} is not a rotation (determinant {np.linalg.det(R):.3g}, off by {error:.2g})")
    return nearest


def _check_camera(
    frames: dict[int, FrameTrack],
    paths: dict[int, Path],
    flaws: list[str],
    complain: Callable[[str], object],
    of_camera: str,
) -> None:
    first_number, first = next(iter(frames.items()))
    worst, worst_number = 0.0, first_number
    most = np.array([*FOCAL_ERROR * first.intrinsics[:2], *(CENTRE_ERROR * side for side in first.size)])
    for number, frame in frames.items():
        if frame.size != first.size:
            complain(
                f"{paths[number]} was tracked on {frame.size[0]}x{frame.size[1]} images but {paths[first_number].name} "
                f"on {first.size[0]}x{first.size[1]}; track the whole video at one size"
            )
            break
        change = float(np.abs((frame.intrinsics - first.intrinsics) / most).max())
        if change > worst:
            worst, worst_number = change, number
    if worst > INTRINSICS_NOTE:
        both = "fx fy cx cy = " + " and ".join(
            f"{' '.join(f'{v:.2f}' for v in frames[n].intrinsics)} with {paths[n].name}"
            for n in (first_number, worst_number)
        )
        focals = [frame.intrinsics[0] for frame in frames.values()]
        both += f"; fx goes from {min(focals):.2f} to {max(focals):.2f}"
        if worst > 1:
            complain(f"the intrinsics{of_camera} change within the clip: {both}; track it again with one fixed camera")
        else:
            flaws.append(
                f"the intrinsics{of_camera} change a little within the clip ({both}); those of the first frame are used"
            )
