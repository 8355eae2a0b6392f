"""Head and mouth mask of a frame: from their own files, or from its face parsing."""

from __future__ import annotations

import numpy as np

from avatar.data.images import read_bytes, read_mask
from data_prep.face_parsing import HEAD, MOUTH, mask_of
from data_prep.frame_files import FrameFiles


def read_masks(files: FrameFiles, number: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Head and mouth mask, uint8 [H, W], or None; the matte stands in where the folder has no head masks.

    Raises UserError naming the file when one cannot be read.
    """
    if number in files.parsing:
        path = files.parsing[number]
        classes = files.decode_parsing(read_bytes(path), path)
        return mask_of(classes, HEAD), mask_of(classes, MOUTH)
    heads = files.head_masks or files.alphas
    head = read_mask(heads[number]) if number in heads else None
    return head, read_mask(files.mouth_masks[number]) if number in files.mouth_masks else None
