"""INSTA's data format, made from a metrical-tracker result.

    FOLDER/transforms_{train,val,test}.json   or one transforms.json
    FOLDER/images/00000.png                   `file_path`; its transparency is the matte of head and neck
    FOLDER/matted/00000.png                   the matte of the whole person, used where the images have none
    FOLDER/seg_mask/00000.png                 `seg_mask_path`: face parsing, each class with its own red
    FOLDER/checkpoint/00000.frame             metrical-tracker's result of the frame

The listing itself has the camera and nothing of jaw, eyes and identity, so `checkpoint/` has to be copied from the
tracker's output (or be named with --tracking).
"""

from __future__ import annotations

from pathlib import Path

from avatar.errors import UserError
from data_prep.formats.face_parsing import decode_reds
from data_prep.formats.frame_files import FrameFiles, KindNames, transparent
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.tracked_folder import TrackedFolder, existing, listings_of, numbered
from data_prep.formats.transforms import ListedFrame, frame_rate

NAME = "INSTA"
NAMES = KindNames("matted/", "seg_mask/", "seg_mask/", images="images/")


def recognise(frames: list[ListedFrame]) -> bool:
    return any({"exp_path", "mesh_path", "seg_mask_path"} & frame.values.keys() for frame in frames[:1])


def open_folder(folder: Path, frames: list[ListedFrame], tracking: Path | None = None) -> TrackedFolder:
    """Raises UserError for paths outside the folder and where the tracker's result is missing."""
    listed = numbered(frames)
    images = {number: frame.image for number, frame in listed.items()}
    result = _tracking_folder(folder, tracking)
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=_mattes(folder, images),
        tracking={number: result / f"{path.stem}.frame" for number, path in images.items()},
        parsing=existing({number: frame.path("seg_mask_path") for number, frame in listed.items()}),
        decode_parsing=decode_reds,
        listings=listings_of(frames),
        names=NAMES,
    )
    division = {number: frame.split for number, frame in listed.items()}
    fps, notes = frame_rate(frames)
    return TrackedFolder(
        NAME,
        files,
        lambda head, size, complain: read_tracking(files.tracking, complain, named_by_number=False),
        division,
        notes,
        fps,
    )


def _tracking_folder(folder: Path, given: Path | None) -> Path:
    candidates = (given, given / "checkpoint") if given else (folder / "checkpoint",)
    for candidate in candidates:
        if candidate.is_dir() and next(candidate.glob("*.frame"), None) is not None:
            return candidate
    raise UserError(
        f"{candidates[-1]} holds no .frame files; INSTA's own files lack jaw, eyes and identity, so copy checkpoint/ "
        "from the metrical-tracker result that the folder was made from, or give --tracking"
    )


def _mattes(folder: Path, images: dict[int, Path]) -> dict[int, Path]:
    matted = {number: folder / "matted" / f"{path.stem}.png" for number, path in images.items()}
    return transparent(images) or existing(matted)
