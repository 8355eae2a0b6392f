"""A recording by several calibrated cameras without any tracking, and the two layouts that are read.

NeRSemble's own, of one sequence; the calibration lies two folders above it:

    ID/calibration/camera_params.json         poses (world to camera, OpenCV's axes); intrinsics, for all or by serial
    ID/calibration/color_calibration.json     by serial a matrix [3, T] (`colour_corrected.py`); may be missing
    ID/sequences/SEQ/images/cam_SERIAL.mp4    FOLDER is ID/sequences/SEQ

What GaussianHeadAvatar's preprocessing makes (`gha_folder.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError
from avatar.files.read import is_there
from data_prep.ffmpeg import count_pictures
from data_prep.formats.frame_track import BadFrame, vector
from data_prep.formats.nersemble import TRAINED_CAMERA, camera_videos
from data_prep.formats.nersemble_cameras import CALIBRATION, read_calibration, read_cameras, read_serials
from data_prep.track.footage.colour_corrected import TERMS, colour_corrected
from data_prep.track.footage.joined import join
from data_prep.track.footage.source import Footage, stride
from data_prep.track.footage.video import Video, open_video

COLOURS = CALIBRATION.with_name("color_calibration.json")
NOMINAL_RATE = 25.0
MAX_DIFFERENCE = 2  # pictures, in length; of more, one is not whole
_MAX_FACTOR = 1e6  # of a colour's terms, which are at most 1
_REMEDY = "download it again, or remove it to leave the colours as they are"


@dataclass(frozen=True)
class Camera:
    footage: Footage
    R: np.ndarray  # [3, 3] from the world to the camera, OpenCV's axes
    t: np.ndarray  # [3] in the calibration's unit
    intrinsics: np.ndarray  # [4] = fx, fy, cx, cy in pixels of the pictures
    mattes: Footage | None = None


@dataclass(frozen=True)
class Recording:
    folder: Path
    cameras: dict[str, Camera]  # by serial
    front: str | None  # the camera before the face, where that is known
    unused: tuple[str, ...] = ()  # cameras that are calibrated and have no pictures
    sequences: tuple[tuple[str, float], ...] = ()  # of several: name, and the second at which it begins


def recognise(folder: Path) -> bool:
    return next((folder / "images").glob("cam_*.mp4"), None) is not None


def open_recording(folder: Path) -> Recording:
    """Raises UserError without a calibration, and where videos and calibration do not belong together."""
    videos = camera_videos(folder / "images")
    person = folder.resolve().parent.parent
    if not (person / CALIBRATION).is_file():
        raise UserError(
            f"{folder} has videos of {len(videos)} cameras, but there is no {person / CALIBRATION}; give "
            "ID/sequences/SEQUENCE of a folder ID that has its calibration"
        )
    unused = without_pictures(set(videos), read_serials(person), person / CALIBRATION)
    matrices = read_colour_matrices(person, videos)
    footage: dict[str, Footage] = {serial: as_converted(open_video(path)) for serial, path in videos.items()}
    counts = {serial: count_pictures(path, "v:0") for serial, path in videos.items()}
    refuse_lengths({videos[serial]: count for serial, count in counts.items()})
    calibrated = read_cameras(person, {serial: (one.width, one.height) for serial, one in footage.items()})
    for serial, matrix in matrices.items():
        footage[serial] = colour_corrected(footage[serial], matrix, person / COLOURS)
    cameras = {serial: Camera(footage[serial], *calibrated[serial][:3]) for serial in videos}
    return Recording(folder, cameras, TRAINED_CAMERA if TRAINED_CAMERA in cameras else None, unused)


def as_converted(video: Video) -> Video:
    """The same, by BT.601 where its colours have no tag, whatever its size: ffmpeg makes pictures into a video so."""
    pixels, matrix, *others = video.colour
    return replace(video, colour=(pixels, "smpte170m" if matrix == "unknown" else matrix, *others))


def read_colour_matrices(person: Path, serials: Iterable[str]) -> dict[str, np.ndarray]:
    """A matrix [3, T] for each serial; nothing where there is no COLOURS. Raises UserError for one that has none."""
    path = person / COLOURS
    if not is_there(path):
        return {}
    raw = read_calibration(path, _REMEDY)
    try:
        return {serial: _colour_matrix(raw, serial) for serial in serials}
    except BadFrame as error:
        raise UserError(f"{path}: {error}; {_REMEDY}") from None


def _colour_matrix(raw: Any, serial: str) -> np.ndarray:
    if not isinstance(raw, dict) or serial not in raw:
        raise BadFrame(f"there is nothing on camera {serial}, which has videos")
    name = f"the matrix of camera {serial}"
    values, shape = vector(raw[serial], name), np.shape(raw[serial])
    if len(shape) != 2 or shape[0] != 3 or shape[1] not in TERMS:
        raise BadFrame(f"{name} has the shape {list(shape)}, not [3, T] with T of {', '.join(map(str, TERMS))}")
    if np.abs(values).max() > _MAX_FACTOR:
        raise BadFrame(f"{name} holds numbers beyond {_MAX_FACTOR:g}")
    return values.reshape(shape)


def join_recordings(recordings: Sequence[Recording]) -> Recording:
    """Sequences of one person, one after the other, by the cameras that filmed all of them.

    Between two of them one time of the front camera has no picture, so that nothing is smoothed from one to the other.
    Raises UserError where they are not of one person's calibration, or one is given twice.
    """
    first = recordings[0]
    folders = [recording.folder.resolve() for recording in recordings]
    if len({folder.parent for folder in folders}) > 1 or len(set(folders)) < len(folders):
        raise UserError(
            "several recordings are tracked together where they are different sequences beside each other, as "
            f"ID/sequences/EXP-1-head and ID/sequences/FREE; {', '.join(str(one.folder) for one in recordings)} are not"
        )
    serials = [serial for serial in first.cameras if all(serial in one.cameras for one in recordings)]
    starts = [0.0]
    for recording in recordings[:-1]:
        lengths = [recording.cameras[serial].footage for serial in serials]
        seconds = max((footage.duration or 0.0 for footage in lengths), default=0.0)
        rate = (lengths[0].rate or NOMINAL_RATE) / stride(lengths[0].rate) if lengths else NOMINAL_RATE
        starts.append(starts[-1] + (math.ceil(seconds * rate - 0.01) + 1) / rate)
    cameras = {
        serial: replace(
            first.cameras[serial], footage=join([one.cameras[serial].footage for one in recordings], starts)
        )
        for serial in serials
    }
    unused = {serial for one in recordings for serial in (*one.cameras, *one.unused)} - set(serials)
    names = tuple(zip((folder.name for folder in folders), starts, strict=True))
    front = first.front if first.front in cameras else None
    return Recording(folders[0].parent, cameras, front, tuple(sorted(unused)), names)


def without_pictures(filmed: set[str], calibrated: set[str], calibration: Path) -> tuple[str, ...]:
    """The calibrated cameras that did not film. Raises UserError for one that filmed and is not calibrated."""
    if unknown := filmed - calibrated:
        raise UserError(
            f"camera {min(unknown)} has pictures, but nothing in {calibration}; calibrate it, or remove its pictures"
        )
    return tuple(sorted(calibrated - filmed))


def refuse_lengths(counts: dict[Path, int]) -> None:
    """Raises UserError where the numbers of pictures differ by more than MAX_DIFFERENCE; else the common ones are used."""
    short, long = min(counts, key=counts.__getitem__), max(counts, key=counts.__getitem__)
    if counts[long] - counts[short] > MAX_DIFFERENCE:
        raise UserError(
            f"{short} has {counts[short]} pictures, but {long} has {counts[long]}; copy the shorter one again, or cut all "
            "cameras alike"
        )
