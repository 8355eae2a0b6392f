"""The square around the head that a tracked folder shows."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np
from jaxtyping import Float

from avatar.errors import UserError
from data_prep.track.footage.source import MIN_SIDE, Box, View

DEFAULT_SIZE = 512  # pixels, as such data sets have
# The square reaches beyond the landmarks, in heights of the face (chin to the top of the forehead).
_ABOVE, _BELOW, _BESIDE = 0.55, 0.75, 0.5
_NEARLY_WHOLE = 0.9  # of the frame's shorter side: then the frame is one of such a data set already
_OUTLIERS = 1.0  # percent of the frames whose landmarks may reach out


def parse_crop(text: str) -> Literal["auto", "none"] | Box:
    """What --crop says. Raises UserError for anything but auto, none and X,Y,W,H."""
    if text in ("auto", "none"):
        return text
    parts = text.split(",")
    if len(parts) != 4 or not all(re.fullmatch(r"[0-9]{1,5}", part.strip()) for part in parts):
        raise UserError(f"--crop must be auto, none or X,Y,W,H in whole pixels of the video, not {text!r}")
    return Box(*(int(part) for part in parts))


def choose_view(
    crop: Literal["auto", "none"] | Box,
    size: int | None,
    width: int,
    height: int,
    points: Float[np.ndarray, "T 478 3"],
) -> View:
    """What is cut out of upright pictures of `width` x `height`, and at which size it is kept; nothing is enlarged.

    `points` are the landmarks in those pictures. `size` is the longer side of the result. Raises UserError for a box
    outside the pictures and for sizes that cannot be had.
    """
    if size is not None and not MIN_SIDE <= size <= 4096:
        raise UserError(f"--size must be from {MIN_SIDE} to 4096 pixels, not {size}")
    if crop == "auto":
        box = head_square(width, height, points)
        wanted = size or DEFAULT_SIZE
    elif crop == "none":
        box, wanted = Box(0, 0, width, height), size or max(width, height)
    else:
        box, wanted = crop, size or max(crop.width, crop.height)
        if box.x + box.width > width or box.y + box.height > height or min(box.width, box.height) < MIN_SIDE:
            raise UserError(
                f"--crop {','.join(map(str, box))} must lie in the video's {width}x{height} pixels and have {MIN_SIDE} a "
                "side at least"
            )
    scale = min(1.0, wanted / max(box.width, box.height))
    return View(box, max(1, round(box.width * scale)), max(1, round(box.height * scale)))


def head_square(width: int, height: int, points: Float[np.ndarray, "T 478 3"]) -> Box:
    """The square with hair and neck around all places where the face is; as much of it as the picture has."""
    xs, ys = points[..., 0], points[..., 1]
    face = float(np.median(ys.max(1) - ys.min(1)))
    left, right = np.percentile(xs.min(1), _OUTLIERS) - _BESIDE * face, np.percentile(xs.max(1), 100 - _OUTLIERS)
    top, bottom = np.percentile(ys.min(1), _OUTLIERS) - _ABOVE * face, np.percentile(ys.max(1), 100 - _OUTLIERS)
    right, bottom = right + _BESIDE * face, bottom + _BELOW * face
    shorter = min(width, height)
    side = max(right - left, bottom - top)
    side = shorter if side > _NEARLY_WHOLE * shorter else max(MIN_SIDE, 2 * round(side / 2))

    def start(low: float, high: float, limit: int) -> int:
        # Even places keep the colours of 4:2:0 video where they are.
        return int(np.clip(2 * round(((low + high - side) / 2) / 2), 0, limit - side))

    return Box(start(left, right, width), start(top, bottom, height), side, side)
