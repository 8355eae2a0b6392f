"""The data of INSTA and NeRFBlendShape as GaussianBlendshapes hands them out, with metrical-tracker's results.

    FOLDER/checkpoint/00000.frame       metrical-tracker's result of the frame
    FOLDER/images/00000.png             the frame of the same number; INSTA's are RGBA, with the matte as alpha
    FOLDER/image_mask/mask_00000.png    the matte of NeRFBlendShape's frames

There is no listing: images and tracking belong together by their numbers. `canonical.obj` and `bc.jpg` are not read.
"""

from __future__ import annotations

from pathlib import Path

from avatar.errors import UserError
from data_prep.formats.frame_files import (
    FrameFiles,
    KindNames,
    find_numbered,
    find_shifted_masks,
    find_tracking,
    transparent,
)
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.tracked_folder import TrackedFolder, matte_notes

NAME = "GaussianBlendshapes"
NAMES = KindNames("image_mask/", "head masks", "mouth masks", images="images/")
INSTA_TESTED, NERFBLENDSHAPE_TESTED = 350, 500  # the last frames, which the papers test


def recognise(folder: Path) -> bool:
    """Whether a folder without a listing has this layout."""
    has_tracking = next((folder / "checkpoint").glob("*.frame"), None) is not None
    return has_tracking and (folder / "images").is_dir()


def open_folder(folder: Path) -> TrackedFolder:
    """Raises UserError for missing or unnumbered files, and where the numbers of tracking or mattes are shifted."""
    images, mattes = find_numbered(folder / "images"), find_numbered(folder / "image_mask")
    if not images:
        raise UserError(f"{folder / 'images'} has no frames: 00000.png, 00001.png ...; copy them again")
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=mattes or transparent(images),
        tracking=find_tracking(folder),
        paired_by="the number in their names",
        names=NAMES,
    )
    _refuse_shifted(files)
    find_shifted_masks(files)
    division, notes = _division(sorted(images.keys() & files.tracking.keys()), bool(mattes))
    return TrackedFolder(
        NAME,
        files,
        lambda head, size, complain: read_tracking(files.tracking, complain),
        division,
        (*matte_notes(files), *notes),
    )


def _division(numbers: list[int], has_mattes: bool) -> tuple[dict[int, str | None], list[str]]:
    """The last frames are tested, as in the papers, where as many are left to train on; else the folder names none."""
    tested = NERFBLENDSHAPE_TESTED if has_mattes else INSTA_TESTED
    if len(numbers) <= tested:
        return {}, []
    if len(numbers) < 2 * tested:
        return {}, [f"the papers test the last {tested} frames, too many of {len(numbers)}: divided as any short clip"]
    return {**dict.fromkeys(numbers, "train"), **dict.fromkeys(numbers[-tested:], "test")}, []


def _refuse_shifted(files: FrameFiles) -> None:
    """Raises UserError where one numbering begins and ends later, so that equal numbers are hardly of one frame."""
    (first, last), (first_tracked, last_tracked) = ((min(n), max(n)) for n in (files.images, files.tracking))
    if (first - first_tracked) * (last - last_tracked) > 0:
        raise UserError(
            f"{files.folder}: images/ has the numbers {first:05d} to {last:05d} and checkpoint/ {first_tracked:05d} to "
            f"{last_tracked:05d}, but equal numbers have to be one frame; rename images/ to imgs/, so that the offset is "
            "looked for"
        )
