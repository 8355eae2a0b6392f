"""How well the projected head lies on the masks: the witness for pairing, conventions and head model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from avatar.data.images import read_mask
from avatar.errors import UserError
from avatar.head.model import HeadModel
from data_prep.projection import project_head, silhouette
from data_prep.tracking import FrameTrack

MIN_OVERLAP = 0.3  # below, the tracking is not of this video or not of this head model
SAMPLED_FRAMES = 24
_RASTER_WIDTH = 256  # pixels
_MASK_ON = 127


def confirm_pairing(
    head: HeadModel, tracks: Mapping[int, FrameTrack], intrinsics: np.ndarray, masks: Mapping[int, Path]
) -> str:
    """Half a sentence with the overlap of head and masks; raises UserError when the head lies elsewhere."""
    common = [number for number in tracks if number in masks]
    if not common:
        return "there are no masks to confirm it with"
    width, height = next(iter(tracks.values())).size
    size = min(_RASTER_WIDTH, width), max(1, round(height * min(_RASTER_WIDTH, width) / width))
    bodies = {}
    for number in common[:: max(1, len(common) // SAMPLED_FRAMES)]:
        screen = project_head(head, tracks[number], intrinsics, *size)
        bodies[number] = silhouette(screen, head.faces.numpy(), *size)
    overlap = mean_overlap(bodies, masks)
    if overlap < MIN_OVERLAP:
        raise UserError(
            f"the tracked head does not lie on the masks (overlap {overlap:.3f}): is the head model the one that the "
            "tracking was made with? Give --frame-offset 0 to go on regardless"
        )
    return f"head overlap {overlap:.3f}"


def mean_overlap(projected: Mapping[int, np.ndarray | None], masks: Mapping[int, Path], offset: int = 0) -> float:
    """Mean IoU of projected and observed masks; frames where both are empty do not count."""
    values = []
    for number, mask in projected.items():
        if mask is None or number + offset not in masks:
            continue
        height, width = mask.shape
        observed = read_mask(masks[number + offset]) > _MASK_ON
        observed = cv2.resize(observed.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        union = int((mask | observed).sum())
        if union:
            values.append(int((mask & observed).sum()) / union)
    return float(np.mean(values)) if values else 0.0
