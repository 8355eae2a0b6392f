"""The folder that GaussianHeadAvatar's preprocessing makes of a recording. Its fit by BFM is not used.

FOLDER/images/0000/image_SERIAL.jpg        one folder for each time
FOLDER/images/0000/mask_SERIAL.jpg         matte, of all pictures or of none
FOLDER/cameras/0000/camera_SERIAL.npz      extrinsic [3, 4] (world to camera, OpenCV's axes), intrinsic [3, 3]
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from avatar.data.read_image import read_mask
from avatar.errors import UserError
from avatar.files.pickles import load_npz
from data_prep.formats.frame_track import BadFrame, pinhole_of, rigid_motion, vector
from data_prep.track.camera_rig.recording import Camera, Recording, refuse_lengths, without_pictures
from data_prep.track.footage.picture_folder import footage_of

_IMAGE = re.compile(r"image_((?!lowres_).+)\.jpg")
_CAMERA = re.compile(r"camera_([0-9]{1,20})\.npz")


def recognise(folder: Path) -> bool:
    return next((folder / "images").glob("[0-9]*/image_*.jpg"), None) is not None


def open_recording(folder: Path) -> Recording:
    """Raises UserError without a calibration, for one that changes, and for times that are not there in all cameras."""
    times = _numbered(folder / "images")
    poses = _numbered(folder / "cameras") if (folder / "cameras").is_dir() else []
    if not poses:
        raise UserError(
            f"{folder} has pictures of several cameras, but no cameras/0000/camera_SERIAL.npz; copy them, too"
        )
    filmed = {time: _serials(time, _IMAGE) for time in times}
    serials = set().union(*filmed.values())
    _refuse_twins(folder / "images", serials)
    whole = [time for time in times if filmed[time] == serials]
    if not (serials and whole):
        raise UserError(f"{folder} has no time of which every camera has a picture; copy it again")
    unused = without_pictures(serials, _serials(poses[0], _CAMERA), poses[0])
    refuse_lengths(
        {folder / "images" / "*" / f"image_{s}.jpg": sum(s in own for own in filmed.values()) for s in serials}
    )
    masks = {time / f"mask_{serial}.jpg" for time in whole for serial in serials}
    missing = {path for path in masks if not path.is_file()}
    if missing and missing != masks:
        raise UserError(f"{min(missing)} is missing, while other pictures have masks; copy it, or remove all masks")
    cameras = {serial: _camera(whole, (poses[0], poses[-1]), serial, not missing) for serial in sorted(serials)}
    return Recording(folder, cameras, None, unused)


def _numbered(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if re.fullmatch(r"[0-9]{1,9}", path.name) and path.is_dir()]
    _refuse_twins(folder, {path.name for path in found})
    return sorted(found, key=lambda path: int(path.name))


def _serials(folder: Path, pattern: re.Pattern[str]) -> set[str]:
    return {found[1] for path in folder.iterdir() if (found := pattern.fullmatch(path.name))}


def _refuse_twins(folder: Path, names: set[str]) -> None:
    """Raises UserError for names that are no number, and for 007 beside 7."""
    known: dict[int, str] = {}
    for name in sorted(names):
        if not re.fullmatch(r"[0-9]{1,20}", name):
            raise UserError(
                f"{folder} has pictures image_{name}.jpg: a camera's serial is a number; rename or remove them"
            )
        if (other := known.setdefault(int(name), name)) != name:
            raise UserError(f"{folder} has pictures of {other} and of {name}, which are one number; remove one of them")


def _camera(times: list[Path], poses: tuple[Path, Path], serial: str, has_masks: bool) -> Camera:
    files = tuple(time / f"image_{serial}.jpg" for time in times)
    footage = footage_of(files[0], files)
    masks = tuple(path.with_name(f"mask_{serial}.jpg") for path in files)
    mattes = replace(footage, files=masks, decode=_read_mask) if has_masks else None
    height, width = read_mask(masks[0]).shape if has_masks else (footage.height, footage.width)
    if (width, height) != (footage.width, footage.height):
        raise UserError(
            f"{masks[0]} is {width}x{height} pixels but {files[0].name} is {footage.width}x{footage.height}; make the "
            "masks of these pictures"
        )
    first, last = (read_calibration(folder / f"camera_{serial}.npz") for folder in poses)
    if any(np.abs(a - b).max() > 1e-6 * np.abs(a).max() for a, b in zip(first, last, strict=True)):
        raise UserError(f"camera {serial} moves between {poses[0]} and {poses[1]}; cameras have to stand still")
    return Camera(footage, *first, mattes)


def _read_mask(file: Path) -> tuple[np.ndarray, bool]:
    return cv2.cvtColor(read_mask(file), cv2.COLOR_GRAY2RGB), False


def read_calibration(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R [3, 3], t [3], and fx, fy, cx, cy."""
    arrays = load_npz(path)
    try:
        if missing := {"extrinsic", "intrinsic"} - arrays.keys():
            raise BadFrame(f"{min(missing)} is missing")
        extrinsic = vector(arrays["extrinsic"], "extrinsic", 12).reshape(3, 4)
        R, t = rigid_motion(np.vstack((extrinsic, [0, 0, 0, 1])), "extrinsic")
        return R, t, pinhole_of(vector(arrays["intrinsic"], "intrinsic", 9).reshape(3, 3), "intrinsic is")
    except BadFrame as error:
        raise UserError(f"{path}: {error}; copy it again") from None
