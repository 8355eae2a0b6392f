"""The folder that `avatar track` writes and `avatar refine` improves.

    FOLDER/tracking.json         format, rate, camera, what was left out, notes, quality
    FOLDER/tracking.npz          one row for each tracked frame, plain arrays (ARRAYS), and its number
    FOLDER/frames/00000.jpg      the pictures (or .png); the number is the time in units of 1 / fps
    FOLDER/matte/00000.png       foreground matte
    FOLDER/head/00000.png        head and neck without clothes
    FOLDER/mouth/00000.png       lips and what is between them
    FOLDER/landmarks.npz         what the tracking was fitted to, for those who refine it

Picture, masks and tracking of a frame have the same number, so no offset is looked for.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.json_values import parse_number, parse_object, parse_value
from avatar.errors import UserError, refuse
from avatar.files.atomic import write_atomically
from avatar.files.pickles import load_npz, save_npz
from avatar.files.read import is_there
from avatar.head.assets import HeadAssets
from data_prep.formats.frame_files import FrameFiles, KindNames, find_numbered
from data_prep.formats.frame_track import FrameTrack, Tracking, nearest_rotation, read_frames, vector
from data_prep.formats.tracked_folder import TrackedFolder
from data_prep.formats.transforms import read_json

NAME = "avatar-track"
VERSION = 1
INFO_FILE, TRACKS_FILE, LANDMARKS_FILE = "tracking.json", "tracking.npz", "landmarks.npz"
FRAMES, MATTE, HEAD, MOUTH = "frames", "matte", "head", "mouth"
NAMES = KindNames("matte/", "head/", "mouth/", images="frames/", tracking=TRACKS_FILE)
# One row a frame, as in `FrameTrack`; its R, t, expression, jaw, eyes, eyelids and neck.
ARRAYS = {"R": (3, 3), "t": (3,), "jaw": (6,), "eyes": (12,), "eyelids": (2,), "neck": (6,), "expression": (None,)}
_MAX_FRAMES = 200_000


@dataclass(frozen=True)
class TrackingInfo:
    """What tracking.json holds besides the format's name and version."""

    fps: float
    width: int  # of the frames, pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the frames
    focal: str  # how the focal length is known, in words
    focal_is_assumed: bool
    head_path: str  # the head model of the tracking, where it lay
    head_fingerprint: str
    source: dict[str, Any]  # the video: its name, SHA-256, which part of it
    left_out: dict[int, str] = field(default_factory=dict)  # frame number -> why there is none
    notes: tuple[str, ...] = ()  # what was assumed or found on the way
    quality: dict[str, Any] = field(default_factory=dict)


def recognise(folder: Path) -> bool:
    return is_there(folder / INFO_FILE)


def open_folder(folder: Path) -> TrackedFolder:
    """Raises UserError for a folder that is not whole."""
    info = read_info(folder)
    images = find_numbered(folder / FRAMES, refuse)
    if not images:
        raise UserError(f"{folder / FRAMES} holds no pictures; track the video again")
    arrays, path = _read_arrays(folder), folder / TRACKS_FILE
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=find_numbered(folder / MATTE, refuse),
        head_masks=find_numbered(folder / HEAD, refuse),
        mouth_masks=find_numbered(folder / MOUTH, refuse),
        tracking=dict.fromkeys(arrays["number"].tolist(), path),
        listings=(folder / INFO_FILE,),
        names=NAMES,
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        if info.head_fingerprint != head.fingerprint:
            complain(
                f"{folder} was tracked with another head model (fingerprint {info.head_fingerprint[:12]}, this one "
                f"{head.fingerprint[:12]}); give {info.head_path} with --head"
            )
        return _tracks(arrays, info, files.tracking, complain)

    assumed = (f"the focal length is {info.focal}: give --focal to avatar track if you know it",)
    return TrackedFolder(NAME, files, read, notes=assumed if info.focal_is_assumed else (), fps=info.fps)


def read_info(folder: Path) -> TrackingInfo:
    """What tracking.json says. Raises UserError for a file that `write_tracking` did not write."""
    path = folder / INFO_FILE
    raw = read_json(path)
    if not isinstance(raw, dict) or raw.get("format") != NAME:
        raise UserError(f"{path} is not the listing of a folder that avatar track wrote")
    if raw.get("version") != VERSION:
        raise UserError(
            f"{path} has version {raw.get('version')!r}, this program reads {VERSION}; track the video again"
        )
    try:
        info = parse_object(raw, TrackingInfo)
        figures = parse_value(info.quality.get("figures", []), tuple[dict[str, Any], ...], "quality.figures")
        for figure in figures:
            parse_number(figure.get("value", 0.0), "a figure of the quality")
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}); track the video again") from None
    is_size = 1 <= info.width < 2**16 and 1 <= info.height < 2**16
    if not is_size or not 0 < info.fps < 1e4 or min(info.intrinsics[:2]) <= 0:
        raise UserError(f"{path} is damaged: its camera or its rate cannot be; track the video again")
    return info


def write_tracking(folder: Path, info: TrackingInfo, tracks: Mapping[int, FrameTrack]) -> None:
    """Write tracking.npz and then tracking.json, each whole or not at all; `tracks` by frame number, one identity."""
    rows = [tracks[number] for number in sorted(tracks)]
    arrays = {name: np.stack([getattr(row, name) for row in rows]).astype(np.float32) for name in ARRAYS}
    arrays |= {"number": np.array(sorted(tracks), np.int64), "shape": rows[0].shape.astype(np.float32)}
    save_npz(folder / TRACKS_FILE, arrays)
    content = {"format": NAME, "version": VERSION} | asdict(info)
    write_atomically(folder / INFO_FILE, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def read_tracks(folder: Path, name: str, complain: Callable[[str], object]) -> Tracking:
    """Another tracking of the folder's frames, in a file `name` of the layout of tracking.npz."""
    arrays = _read_arrays(folder, name)
    return _tracks(arrays, read_info(folder), dict.fromkeys(arrays["number"].tolist(), folder / name), complain)


def _read_arrays(folder: Path, name: str = TRACKS_FILE) -> dict[str, np.ndarray]:
    path = folder / name
    arrays = load_npz(path)
    number = arrays.get("number")
    if number is None or number.ndim != 1 or number.dtype.kind not in "iu" or not 0 < len(number) <= _MAX_FRAMES:
        raise UserError(f"{path} is damaged: it has no list of frame numbers; track the video again")
    if number.min() < 0 or number.max() >= 2**31 or (np.diff(number.astype(np.int64)) <= 0).any():
        raise UserError(f"{path} is damaged: its frame numbers do not increase; track the video again")
    for name, shape in ARRAYS.items():
        array = arrays.get(name)
        fits = array is not None and array.dtype.kind == "f" and array.ndim == 1 + len(shape)
        sizes = () if array is None or not fits else array.shape
        if not fits or any(want not in (None, have) for want, have in zip((len(number), *shape), sizes, strict=True)):
            raise UserError(f"{path} is damaged: {name} is missing or of the wrong shape; track the video again")
    shape = arrays.get("shape")
    if shape is None or shape.ndim != 1 or shape.dtype.kind != "f":
        raise UserError(f"{path} is damaged: shape is missing or of the wrong shape; track the video again")
    return arrays


def _tracks(
    arrays: dict[str, np.ndarray], info: TrackingInfo, paths: dict[int, Path], complain: Callable[[str], object]
) -> Tracking:
    def read(row: int) -> FrameTrack:
        values: dict[str, Any] = {name: vector(arrays[name][row], name) for name in ARRAYS}
        values["R"] = nearest_rotation(values["R"].reshape(3, 3), "R")
        return FrameTrack(
            **values,
            shape=vector(arrays["shape"], "shape"),
            intrinsics=np.array(info.intrinsics),
            size=(info.width, info.height),
        )

    return read_frames({number: row for row, number in enumerate(arrays["number"].tolist())}, read, paths, complain)
