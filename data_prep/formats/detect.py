"""Which program's layout a tracked folder has, found from its files, never from its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from avatar.errors import UserError, refuse
from data_prep.formats import avatar_track, blendshapes, imavatar, insta, nersemble, nha, refined_folder, vhap
from data_prep.formats.frame_files import find_frame_files
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.tracked_folder import TrackedFolder, matte_notes
from data_prep.formats.train_test_split import ALL, FRONT
from data_prep.formats.transforms import ListedFrame, read_listings

METRICAL_TRACKER = "metrical-tracker"
_LISTED = {module.NAME: module for module in (vhap, insta, imavatar)}
_BY_FILES = {module.NAME: module for module in (blendshapes, nersemble, nha)}  # have no listing of frames
FORMATS = (METRICAL_TRACKER, *_LISTED, *_BY_FILES, avatar_track.NAME)


def open_tracked_folder(
    folder: Path,
    tracking: Path | None = None,
    format: str | None = None,
    complain: Callable[[str], object] = refuse,
    cameras: str | None = None,
) -> TrackedFolder:
    """The folder in the form that `prepare` works on; `format` is one of FORMATS, or None to tell it from the files.

    cameras  of a folder with several: "all", "front" or names between commas; None: all

    Raises UserError when the folder is in none of the formats, or in several, or not in the one that was asked for.
    What is wrong with the files of a metrical-tracker folder goes to `complain`, as in `find_frame_files`.
    """
    cameras = ALL if cameras is None else cameras
    if format not in (None, *FORMATS):
        raise UserError(f"--data-format must be one of {', '.join(FORMATS)}, not {format!r}")
    if format == avatar_track.NAME or (format is None and avatar_track.recognise(folder)):
        if tracking is not None:
            raise UserError("--tracking is for .frame files; a folder of avatar track holds its own tracking")
        return refined_folder.open_folder(folder, cameras)
    is_listed = folder.is_dir() and (format is None or format in _LISTED)
    frames = read_listings(folder) if is_listed else []
    name = format or detect_format(folder, frames)
    if cameras not in (ALL, FRONT) and name not in (vhap.NAME, nersemble.NAME):
        raise UserError(f"--cameras is for folders of several cameras, and {folder} is {name}'s, of one")
    if name == METRICAL_TRACKER:
        files = find_frame_files(folder, tracking, complain)
        return TrackedFolder(
            name,
            files,
            lambda head, size, complain: read_tracking(files.tracking, complain),
            notes=matte_notes(files),
        )
    is_one = _BY_FILES[name].recognise(folder) if name in _BY_FILES else _LISTED[name].recognise(frames)
    if not is_one:
        raise UserError(f"{folder} is not a folder of {name}'s: docs/data.md says which files and values belong to it")
    if name == insta.NAME:
        return insta.open_folder(folder, frames, tracking)
    if tracking is not None:
        where = "is in the folder itself" if name in _BY_FILES else "is named by the listing"
        raise UserError(f"--tracking is for .frame files; in a folder of {name}'s the tracking {where}")
    if name == vhap.NAME:
        return vhap.open_folder(folder, frames, cameras)
    if name == nersemble.NAME:
        return nersemble.open_folder(folder, cameras)
    if name in _BY_FILES:
        return _BY_FILES[name].open_folder(folder)
    return _LISTED[name].open_folder(folder, frames)


def detect_format(folder: Path, frames: list[ListedFrame]) -> str:
    """A folder with imgs/ is metrical-tracker's; listings are distinguished by what their first frame has, other folders by
    their files."""
    found = [METRICAL_TRACKER] if (folder / "imgs").is_dir() else []
    found += [name for name, module in _LISTED.items() if module.recognise(frames)]
    found += [name for name, module in _BY_FILES.items() if not frames and module.recognise(folder)]
    if len(found) > 1:
        raise UserError(f"{folder} could be a folder of {' or '.join(found)}; say which with --data-format")
    if not found and frames:
        first = frames[0]
        hint = (
            "its `expression` is not FLAME's, as in NeRFace's data; track the video with one of the programs below: "
            if "expression" in first.values
            else ""
        )
        raise UserError(
            f"{first.listing} is a listing of frames, but {hint}it has no FLAME parameters of {', '.join(_LISTED)}"
        )
    return found[0] if found else METRICAL_TRACKER
