"""The data set of Neural Head Avatars (NHA). Never tried on a real archive.

    FOLDER/frame_0000/image_0000.png      the picture
    FOLDER/frame_0000/seg_0000.png        labels: 101 head; 0 is taken as the background, every other one as the person
    FOLDER/frame_0000/parsing_0000.png    class numbers of the face parsing network
    FOLDER/split.json                     frame numbers under `train` and `val`; the latter are tested
    FOLDER/tracked_flame_params*.npz      a row for each tracked frame, whose number is in `frame` [T]

The rows are `rotation`, `translation`, `neck_pose`, `jaw_pose` [T, 3], `eyes_pose` [T, 6] and `expr` [T, E]. All frames
share `shape` [S], `image_size` = h, w, `K` = f, cx, cy in units of the longer side, the width and the height, and the
camera `RT` [3, 4]. A vertex v of FLAME without a global turn is at `R (v - j) + translation`, where j is its root joint, in
PyTorch3D's axes: x left, y up, z forward. cy is counted from the bottom of the picture. Neck, jaw and eyes are stored as x
of the rotation vectors `lo + (tanh x + 1) / 2 (hi - lo)`. There are no eyelids: they are zero.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.data.read_image import EVERY_LABEL
from avatar.errors import UserError
from avatar.files.pickles import load_npz
from avatar.files.read import is_there
from avatar.head.assets import HeadAssets
from avatar.head.model import NECK, ROOT
from data_prep.formats.frame_files import ALPHA, FrameFiles, KindNames, transparent
from data_prep.formats.frame_track import (
    BadFrame,
    FrameTrack,
    Tracking,
    nearest_rotation,
    read_frames,
    rows_of,
    vector,
)
from data_prep.formats.root_pose import Joint, camera_of_head, rotation_matrix, six_d, turned_with_neck
from data_prep.formats.tracked_folder import TrackedFolder, existing, matte_notes
from data_prep.formats.transforms import read_json

NAME = "NHA"
IMAGE, SEG, PARSING, SPLIT = "image_0000.png", "seg_0000.png", "parsing_0000.png", "split.json"
TRACKED = "tracked_flame_params*.npz"
NAMES = KindNames(SEG, PARSING, PARSING, images=IMAGE, tracking=TRACKED)
OPENCV_FROM_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
_LABELS = "in seg_0000.png 0 is taken as the background and every other label as the person"
_WIDTHS = {"rotation": 3, "translation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "expr": None}
_SHARED = ("frame", "shape", "image_size", "K", "RT")
_EYE = ((-50.0, 50.0), (-50.0, 50.0), (-0.1, 0.1))
_LIMITS = {  # lo, hi of each value, degrees
    "neck_pose": ((-90.0, 90.0), (-60.0, 60.0), (-80.0, 80.0)),
    "jaw_pose": ((-5.0, 60.0), (-0.1, 0.1), (-0.1, 0.1)),
    "eyes_pose": (*_EYE, *_EYE),
}


class HeadTracking(NamedTuple):
    path: Path
    shape: np.ndarray  # [S]
    intrinsics: np.ndarray  # [4] = fx, fy, cx, cy in pixels, from the top left
    size: tuple[int, int]  # width, height
    R: np.ndarray  # [3, 3] from the world to OpenCV's axes
    t: np.ndarray  # [3]
    places: dict[int, int]  # frame number -> row, by number
    rows: dict[str, np.ndarray]  # [T, width], of _WIDTHS

    def frame(self, row: int, root: Joint, neck: Joint) -> FrameTrack:
        """Raises BadFrame for a row that is not finite."""
        of = {name: vector(values[row], name) for name, values in self.rows.items()}
        angles = {name: _limited(of[name], name) for name in _LIMITS}
        joint = root.position(self.shape, of["expr"])
        torso = camera_of_head(self.R, self.t, rotation_matrix(of["rotation"]), of["translation"] - joint, joint)
        R, t = turned_with_neck(torso, angles["neck_pose"], neck.position(self.shape))
        return FrameTrack(
            expression=of["expr"],
            jaw=six_d(angles["jaw_pose"]),
            eyes=six_d(angles["eyes_pose"]),
            eyelids=np.zeros(2),
            neck=six_d(angles["neck_pose"]),
            R=R,
            t=t,
            shape=self.shape,
            intrinsics=self.intrinsics,
            size=self.size,
        )


def recognise(folder: Path) -> bool:
    return any((place / IMAGE).is_file() for place in _frame_folders(folder).values())


def open_folder(folder: Path) -> TrackedFolder:
    """Raises UserError for tracking or a division that is missing, damaged or there twice."""
    tracking = read_tracking(_tracking_file(folder))
    places = _frame_folders(folder)
    images = {number: place / IMAGE for number, place in places.items()}
    mattes = existing({number: place / SEG for number, place in places.items()})
    split = folder / SPLIT
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=mattes or transparent(images),
        tracking=dict.fromkeys(tracking.places, tracking.path),
        parsing=existing({number: place / PARSING for number, place in places.items()}),
        listings=(split,),
        paired_by=f"the frame numbers in {tracking.path.name}",
        names=NAMES,
        labels={ALPHA: EVERY_LABEL} if mattes else {},
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        root, neck = Joint(head, ROOT), Joint(head, NECK)
        return read_frames(tracking.places, lambda row: tracking.frame(row, root, neck), files.tracking, complain)

    notes = (_LABELS,) if mattes else matte_notes(files)
    return TrackedFolder(NAME, files, read, _division(split) if is_there(split) else {}, notes)


def _frame_folders(folder: Path) -> dict[int, Path]:
    """By frame number, in their order."""
    found = ((re.fullmatch(r"frame_([0-9]{4}|[1-9][0-9]{4,6})", path.name), path) for path in folder.glob("frame_*"))
    return dict(sorted((int(name[1]), path) for name, path in found if name is not None))


def read_tracking(path: Path) -> HeadTracking:
    """Raises UserError for a file that cannot be read, and for values that are missing or of another shape."""
    raw = load_npz(path)
    missing = {*_WIDTHS, *_SHARED} - raw.keys()
    if missing:
        raise UserError(f"{path} lacks {', '.join(sorted(missing))}; copy it again")
    try:
        frames = vector(raw["frame"], "frame")
        if not len(frames) or (frames % 1).any() or frames.min() < 0 or frames.max() >= 2**31:
            raise BadFrame("frame does not hold whole numbers from 0 on")
        places = {int(frame): row for row, frame in enumerate(frames)}
        if len(places) < len(frames):
            raise BadFrame(f"{len(frames) - len(places)} of {len(frames)} numbers in frame are there twice")
        height, width = size = vector(raw["image_size"], "image_size", 2)
        if (size % 1).any() or size.min() < 1 or size.max() >= 2**16:
            raise BadFrame(f"image_size is {height:g} and {width:g}, which no image is")
        f, cx, cy = vector(raw["K"], "K", 3)
        if not (0 < f < 1e3 and 0 < cx < 1 and 0 < cy < 1):
            raise BadFrame(f"K is {f:g}, {cx:g}, {cy:g}, no lens in units of the picture")
        RT = vector(raw["RT"], "RT", 12).reshape(3, 4)
        return HeadTracking(
            path,
            vector(raw["shape"], "shape"),
            np.array([f * size.max(), f * size.max(), cx * width, height - cy * height]),
            (int(width), int(height)),
            OPENCV_FROM_PYTORCH3D @ nearest_rotation(RT[:, :3], "RT"),
            OPENCV_FROM_PYTORCH3D @ RT[:, 3],
            dict(sorted(places.items())),
            {name: rows_of(raw[name], name, len(frames), width) for name, width in _WIDTHS.items()},
        )
    except BadFrame as error:
        raise UserError(f"{path}: {error}; copy it or track the folder again") from None


def _tracking_file(folder: Path) -> Path:
    found = sorted(folder.glob(TRACKED))
    if not found:
        raise UserError(f"{folder} holds no {TRACKED}; copy it into the folder")
    if len(found) > 1:
        raise UserError(f"{folder} holds {', '.join(path.name for path in found)}; keep one of them there")
    return found[0]


def _division(path: Path) -> dict[int, str | None]:
    """What each frame is for, by its number. A frame in both lists is tested. Raises UserError for a damaged file."""
    raw = read_json(path)
    division: dict[int, str | None] = {}
    for part, use in (("train", "train"), ("val", "test")):
        listed = raw.get(part) if isinstance(raw, dict) else None
        # 12, "12" or "frame_0012"
        entries = listed if isinstance(listed, list) else [None]
        names = [re.fullmatch(r"(?:frame_)?([0-9]{1,9})", str(entry)) for entry in entries]
        if None in names:
            raise UserError(f"{path} has no list of frame numbers under '{part}'; copy it again, or remove it")
        division |= {int(name[1]): use for name in names if name is not None}
    return division


def _limited(stored: np.ndarray, name: str) -> np.ndarray:
    """Radians, between the limits, of what is stored."""
    lo, hi = np.radians(_LIMITS[name]).T
    return lo + (np.tanh(stored) + 1) / 2 * (hi - lo)
