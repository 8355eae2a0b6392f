"""Sharp mattes from those of a segmentation network and the colours at the person's edge.

The network knows where the person ends to a pixel of its own; it fills gaps, which a camera that stands still shows
(`background_plate.py`). Within that, around the head, closed-form matting says what the colours say (neither a guided
filter nor GrabCut did).
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from data_prep.track.mattes.background_plate import Plate, shown
from data_prep.track.mattes.closed_form_matting import band_radius, closed_form, within_limits

_SURE = 0.05  # probability below which, and below 1 minus which, a pixel off the edge is left to the network
_STEEPER = 1.5  # times, about a half: closed-form matting spreads an edge over more pixels than it covers
# How far hair, ears and neck reach beyond the landmarks' box, of its longer side: above, beside, below.
_ABOVE, _BESIDE, _BELOW = 0.75, 0.5, 0.6


def sharpened(
    image: UInt8[np.ndarray, "H W 3"],
    matte: UInt8[np.ndarray, "H W"],
    points: Float[np.ndarray, "L 2"],
    plate: Plate | None = None,
) -> UInt8[np.ndarray, "H W"]:
    """A network's matte with the colours' edge around the head, whose landmarks are `points` in pixels of the image.

    `plate` is what stands behind the person, where it is known.
    """
    return within_limits(partial(_sharpened, plate), image, matte, _about_head(points, *matte.shape))


def _sharpened(plate: Plate | None, image: np.ndarray, matte: np.ndarray, near_head: np.ndarray) -> np.ndarray:
    probability = matte.astype(np.float32) / 255.0
    person = (probability > 0.5).astype(np.uint8)
    empty = np.zeros(matte.shape, bool) if plate is None else shown(plate, image, person > 0)
    person[empty] = 0
    reach = 2 * band_radius(*matte.shape) + 1
    edge = cv2.morphologyEx(person, cv2.MORPH_GRADIENT, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    unsure = (probability > _SURE) & (probability < 1.0 - _SURE)
    near = near_head > 0
    band = ((edge > 0) | unsure) & near & ~empty
    known = np.where(near & ~band, person.astype(np.float32), probability)
    share = closed_form(image, known, band)
    share[band] = np.clip(0.5 + _STEEPER * (share[band] - 0.5), 0.0, 1.0)
    return np.rint(share * 255.0).astype(np.uint8)


def _about_head(points: np.ndarray, height: int, width: int) -> UInt8[np.ndarray, "H W"]:
    """255 where hair, ears and neck may be."""
    inside = np.zeros((height, width), np.uint8)
    if not np.isfinite(points).all():
        return inside
    (left, top), (right, bottom) = points.min(0), points.max(0)
    side = max(right - left, bottom - top)
    rows = np.clip([top - _ABOVE * side, bottom + _BELOW * side], 0, height).astype(int)
    columns = np.clip([left - _BESIDE * side, right + _BESIDE * side], 0, width).astype(int)
    inside[rows[0] : rows[1], columns[0] : columns[1]] = 255
    return inside
