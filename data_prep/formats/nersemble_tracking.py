"""NeRSemble's tracking of one sequence by FLAME 2023, read as data that may be wrong.

A vertex v of FLAME without a global turn is at `scale * R v + translation` in the world: R turns it about the model's
origin, not about the root joint. R is in `rotation_matrices`, and in `rotation` as angles, R = Rx Ry Rz.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.errors import UserError
from avatar.files.pickles import load_npz
from avatar.files.read import is_there
from data_prep.formats.frame_track import BadFrame, FrameTrack, nearest_rotation, rows_of, vector
from data_prep.formats.nersemble_cameras import CalibratedCamera
from data_prep.formats.root_pose import Joint, rotation_matrix, six_d, turned_with_neck

FILES = ("flame2023_tracking_v2.npz", "flame2023_tracking.npz")  # the newer first
_TURNS = {"rotation_matrices": 9, "rotation": 3}  # the first that is there is taken
_WIDTHS = {"expression": None, "translation": 3, "jaw": 3, "neck": 3, "eyes": 6}  # values a row; None: any number


class SequenceTracking(NamedTuple):
    path: Path
    shape: np.ndarray  # [S]
    scale: float
    frames: np.ndarray  # [T] whole numbers, increasing
    rows: dict[str, np.ndarray]  # [T, width], of _WIDTHS and one of _TURNS

    def pictures(self, count: int) -> tuple[int, ...]:
        """Which of the `count` pictures of a video each row is of.

        `frames` may count the pictures of the recording that the video was made from: then the rows are the pictures.
        Raises UserError where neither fits.
        """
        steps = np.diff(self.frames)
        if len(self.frames) == count and (steps == steps[:1]).all():
            return tuple(range(count))
        if self.frames[-1] < count:
            return tuple(int(frame) for frame in self.frames)
        raise UserError(
            f"{self.path} tracks {len(self.frames)} pictures, the last with number {self.frames[-1]}, but the videos have "
            f"{count}; download both again"
        )

    def frame(self, row: int, shape: np.ndarray, neck: Joint, camera: CalibratedCamera) -> FrameTrack:
        """The head before a camera, in units of the head model. Raises BadFrame for a row that is not finite."""
        of = {name: vector(values[row], name) for name, values in self.rows.items()}
        torso = camera.R @ _turn(of), (camera.R @ of["translation"] + camera.t) / self.scale
        R, t = turned_with_neck(torso, of["neck"], neck.position(shape))
        return FrameTrack(
            expression=of["expression"],
            jaw=six_d(of["jaw"]),
            eyes=six_d(of["eyes"]),
            eyelids=np.zeros(2),
            neck=six_d(of["neck"]),
            R=R,
            t=t,
            shape=shape,
            intrinsics=camera.intrinsics,
            size=camera.size,
        )


def find_tracking(sequence: Path) -> Path | None:
    """The tracking file of a sequence."""
    places = [sequence / "tracking" / name for name in FILES]
    return next((path for path in places if is_there(path)), None)


def read_tracking(path: Path) -> SequenceTracking:
    """Raises UserError for a file that cannot be read, and for values that are missing or of another shape."""
    raw = load_npz(path)
    turn = next((name for name in _TURNS if name in raw), next(iter(_TURNS)))
    widths = {**_WIDTHS, turn: _TURNS[turn]}
    missing = {*widths, "shape", "scale", "frames"} - raw.keys()
    if missing:
        raise UserError(f"{path} lacks {', '.join(sorted(missing))}; download it again")
    try:
        shape, scale = vector(raw["shape"], "shape"), float(vector(raw["scale"], "scale", 1)[0])
        frames = vector(raw["frames"], "frames")
        if scale <= 0:
            raise BadFrame(f"scale is {scale:g}, not above 0")
        if not len(frames) or (frames % 1).any() or (np.diff(frames, prepend=-1) <= 0).any() or frames[-1] >= 2**31:
            raise BadFrame("frames are not increasing whole numbers from 0 on")
        rows = {name: rows_of(raw[name], name, len(frames), width) for name, width in widths.items()}
    except BadFrame as error:
        raise UserError(f"{path}: {error}; download it again") from None
    return SequenceTracking(path, shape, scale, frames.astype(np.int64), rows)


def _turn(row: dict[str, np.ndarray]) -> np.ndarray:
    if "rotation_matrices" in row:
        return nearest_rotation(row["rotation_matrices"].reshape(3, 3), "rotation_matrices")
    Rx, Ry, Rz = (rotation_matrix(angle * axis) for angle, axis in zip(row["rotation"], np.eye(3), strict=True))
    return Rx @ Ry @ Rz
