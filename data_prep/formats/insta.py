"""INSTA's data format, made from a metrical-tracker result.

    FOLDER/transforms_{train,val,test}.json   or one transforms.json
    FOLDER/images/00000.png                   `file_path`; its transparency is the matte of head and neck
    FOLDER/matted/00000.png                   the matte of the whole person, used where the images have none
    FOLDER/seg_mask/00000.png                 `seg_mask_path`: face parsing, each class with its own red
    FOLDER/checkpoint/00000.frame             metrical-tracker's result of the frame, or else
    FOLDER/meshes/00000.obj                   `mesh_path`: the tracked head (see `insta_meshes`)

The listing itself has the camera and nothing of jaw, eyes and identity.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.formats.face_parsing import decode_reds
from data_prep.formats.frame_files import FrameFiles, KindNames, transparent
from data_prep.formats.frame_track import Tracking
from data_prep.formats.insta_meshes import CANONICAL, mesh_paths, read_meshes
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.tracked_folder import TrackedFolder, existing, listings_of
from data_prep.formats.transforms import ListedFrame, frame_rate, numbered

NAME = "INSTA"
NAMES = KindNames("matted/", "seg_mask/", "seg_mask/", images="images/")


def recognise(frames: list[ListedFrame]) -> bool:
    return any({"exp_path", "mesh_path", "seg_mask_path"} & frame.values.keys() for frame in frames[:1])


def open_folder(folder: Path, frames: list[ListedFrame], tracking: Path | None = None) -> TrackedFolder:
    """Raises UserError for paths outside the folder, and where there is neither the tracker's result nor a mesh."""
    listed = numbered(frames)
    images = {number: frame.image for number, frame in listed.items()}
    result = _result_folder(folder, tracking)
    if result is None and tracking is not None:
        raise UserError(f"{tracking} holds no .frame files of metrical-tracker; give --tracking the folder that does")
    meshes = {} if result is not None else mesh_paths(listed)
    if result is None and not meshes:
        raise UserError(
            f"{folder} holds no checkpoint/*.frame of metrical-tracker and none of the meshes that the listing names; "
            "copy either there, or give --tracking"
        )
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=_mattes(folder, images),
        tracking=meshes or {number: result / f"{path.stem}.frame" for number, path in images.items() if result},
        parsing=existing({number: frame.path("seg_mask_path") for number, frame in listed.items()}),
        decode_parsing=decode_reds,
        listings=(*listings_of(frames), *(_beside(folder, listed) if meshes else [])),
        names=NAMES._replace(tracking="meshes/") if meshes else NAMES,
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        if meshes:
            return read_meshes(folder, listed, head, size, complain)
        return read_tracking(files.tracking, complain, named_by_number=False)

    division = {number: frame.split for number, frame in listed.items()}
    fps, notes = frame_rate(frames)
    return TrackedFolder(NAME, files, read, division, notes, fps)


def _result_folder(folder: Path, given: Path | None) -> Path | None:
    candidates = (given, given / "checkpoint") if given else (folder / "checkpoint",)
    return next((place for place in candidates if place.is_dir() and next(place.glob("*.frame"), None)), None)


def _beside(folder: Path, listed: dict[int, ListedFrame]) -> list[Path]:
    """What the fit to the meshes reads as well."""
    return [folder / CANONICAL, *(path for frame in listed.values() if (path := frame.path("exp_path")) is not None)]


def _mattes(folder: Path, images: dict[int, Path]) -> dict[int, Path]:
    matted = {number: folder / "matted" / f"{path.stem}.png" for number, path in images.items()}
    return transparent(images) or existing(matted)
