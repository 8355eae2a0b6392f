"""NeRSemble's calibration, read as data that may be wrong."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avatar.errors import UserError
from avatar.files.read import read_text
from data_prep.formats.frame_track import BadFrame, pinhole_of, rigid_motion, vector

CALIBRATION = Path("calibration", "camera_params.json")
_MAX_BYTES = 2**20  # 16 cameras take 6 KB


class CalibratedCamera(NamedTuple):
    R: np.ndarray  # [3, 3] from the world to the camera, OpenCV's axes
    t: np.ndarray  # [3]
    intrinsics: np.ndarray  # [4] = fx, fy, cx, cy in pixels
    size: tuple[int, int]  # width, height of its videos


def read_cameras(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> dict[str, CalibratedCamera]:
    """The cameras whose videos have these (width, height), by serial.

    Raises UserError for a serial that is not calibrated, and for values that no camera has.
    """
    path = folder / CALIBRATION
    poses, lenses = _poses_and_lenses(path)
    cameras: dict[str, CalibratedCamera] = {}
    for serial, (width, height) in sizes.items():
        lens = lenses.get(serial) if isinstance(lenses, dict) else lenses  # one for all
        if serial not in poses or lens is None:
            raise UserError(
                f"{path} has nothing on camera {serial}, of which there are videos; leave it out with --cameras"
            )
        try:
            pose = vector(poses[serial], "world_2_cam", 16).reshape(4, 4)
            K = vector(lens, "intrinsics", 9).reshape(3, 3)
            camera = CalibratedCamera(
                *rigid_motion(pose, "world_2_cam"), pinhole_of(K, "intrinsics are"), (width, height)
            )
        except BadFrame as error:
            raise UserError(f"{path}: camera {serial}: {error}; download it again") from None
        cx, cy = camera.intrinsics[2:]
        if not (0 <= cx <= width and 0 <= cy <= height):
            raise UserError(
                f"{path}: the principal point of camera {serial} is at {cx:g}, {cy:g}, but its videos have "
                f"{width}x{height} pixels; give the videos for which it was calibrated"
            )
        cameras[serial] = camera
    return cameras


def read_serials(folder: Path) -> set[str]:
    """Of the cameras that are calibrated."""
    return set(_poses_and_lenses(folder / CALIBRATION)[0])


def _poses_and_lenses(path: Path) -> tuple[dict[str, Any], Any]:
    raw = read_calibration(path)
    poses, lenses = (raw.get(key) for key in ("world_2_cam", "intrinsics")) if isinstance(raw, dict) else (None, None)
    if not isinstance(poses, dict) or lenses is None:
        raise UserError(f"{path} lacks world_2_cam or intrinsics; download it again")
    return poses, lenses


def read_calibration(path: Path, remedy: str = "download it again") -> Any:
    """The values of a JSON file. Raises UserError, which ends with `remedy`, where it is none or has a name twice."""
    try:
        return json.loads(read_text(path, _MAX_BYTES), object_pairs_hook=_without_repeats)
    except BadFrame as error:
        raise UserError(f"{path}: {error}; {remedy}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as JSON ({error}); {remedy}") from None


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise BadFrame(f"{next(name for name in names if names.count(name) > 1)} is there twice")
    return values
