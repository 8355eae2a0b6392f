"""Head and mouth mask of a frame: from their own files, from its face parsing, or from the projected head."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avatar.data.manifest import Manifest
from avatar.files.write_image import write_image
from avatar.head.model import HeadModel
from data_prep.formats import frame_files
from data_prep.formats.face_parsing import HEAD, MOUTH, mask_of
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import Tracking
from data_prep.prepare.projection import filled_lips, lip_faces, project_head


def read_masks(files: FrameFiles, number: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Head and mouth mask, uint8 [H, W], or None; the matte stands in where the folder has no head masks.

    Raises UserError naming the file when one cannot be read.
    """
    if (classes := files.read(frame_files.PARSING, number)) is not None:
        return mask_of(classes, HEAD), mask_of(classes, MOUTH)
    head = frame_files.HEAD if files.head_masks else frame_files.ALPHA
    return files.read(head, number), files.read(frame_files.MOUTH, number)


def derive_masks(
    building: Path,
    manifest: Manifest,
    files: FrameFiles,
    model: HeadModel,
    tracks: Tracking,
    pairs: Sequence[tuple[int, int]],
) -> None:
    """Write the masks that the source does not have into `building`: from its face parsing, else the projected lips.

    pairs  image number and tracking number of each of the manifest's frames
    """
    for record in manifest.frames[:1]:
        for path, kind in ((record.head_mask, manifest.head_masks), (record.mouth_mask, manifest.mouth_masks)):
            if kind == "derived":
                (building / str(path)).parent.mkdir()
    lips = lip_faces(model)
    for record, (image, number) in zip(manifest.frames, pairs, strict=True):
        head, mouth = read_masks(files, image) if image in files.parsing else (None, None)
        if manifest.head_masks == "derived" and head is not None:
            write_image(building / str(record.head_mask), head)
        if manifest.mouth_masks == "derived":
            if mouth is None:
                track = tracks.frames[number]
                screen = project_head(model, track, track.intrinsics, *track.size)
                mouth = filled_lips(screen, lips, *track.size).astype(np.uint8) * 255
            write_image(building / str(record.mouth_mask), mouth)
