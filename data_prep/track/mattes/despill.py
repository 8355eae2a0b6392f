"""The background's colours on the person: along the outline, as far as compression and subsampled colours blur the video.

A matte says where the person ends; a video of few bits shows a rim of the wall inside it, and an avatar would wear it over
every other background. How far it reaches is measured over the clip, and sharp clips stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

CLIP_FRAMES = 12  # that say how far it reaches
_REACH = 64  # of these in the longer side is the farthest that is looked for
_LEAST = 0.12  # share of the background's colour in the second pixel: with less, it is shading that would be taken out
_GONE = 0.05  # share beyond which there is nothing to take out
_DISTINCT = 0.15  # distance of colours in [0, 1]: those of person and background that are nearer cannot be separated
_FEW = 20  # pixels


class Rim(NamedTuple):
    """The surroundings of a matte's edge. A pixel's colour lies between the person's and the background's nearby."""

    share: Float32[np.ndarray, "H W"]  # of the way from the person's to the background's
    away: Float32[np.ndarray, "H W 3"]  # from the person's colour to the background's, in [-1, 1]
    known: Bool[np.ndarray, "H W"]  # where both colours are near, and unlike


def spill_width(frames: Iterable[tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]]) -> int:
    """How many pixels the background's colours reach into the mattes (0 to 255) of images; 0 where edges are sharp."""
    profiles = [_profile(image, matte) for image, matte in frames]
    seen = [profile for profile in profiles if not np.isnan(profile).any()]
    if not seen:
        return 0
    profile = np.mean(seen, axis=0)
    return int(np.argmax(np.append(profile, 0.0) < _GONE)) if profile[1] > _LEAST else 0


def despilled(
    image: UInt8[np.ndarray, "H W 3"], matte: UInt8[np.ndarray, "H W"], width: int
) -> UInt8[np.ndarray, "H W 3"]:
    """The image without the background's share in its colours, `width` pixels inside the matte's edge and where it is soft.

    What else distinguishes a pixel from the person's mean colour there stays.
    """
    rim, inner = _rim(image, matte, width + 1)
    share = np.where(rim.known & ~inner & (matte > 0), np.clip(rim.share, 0.0, 1.0), 0.0)
    return np.rint(np.clip(image - 255.0 * share[..., None] * rim.away, 0.0, 255.0)).astype(np.uint8)


def _profile(image: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """The median share by whole pixels from the edge inwards, [reach]; NaN where too few pixels say."""
    reach = max(3, -(-max(matte.shape) // _REACH))
    rim, _ = _rim(image, matte, reach)
    distance = cv2.distanceTransform(_solid(matte), cv2.DIST_L2, 5)
    rings = [rim.share[rim.known & (distance > d) & (distance <= d + 1)] for d in range(reach)]
    return np.array([np.median(ring) if len(ring) >= _FEW else np.nan for ring in rings])


def _rim(image: np.ndarray, matte: np.ndarray, reach: int) -> tuple[Rim, Bool[np.ndarray, "H W"]]:
    """And the inside, `reach` pixels from the edge, from which the person's colours are."""
    colours = image.astype(np.float32) / 255.0
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    inner = cv2.erode(_solid(matte), disc, borderValue=1) > 0
    outer = cv2.dilate((matte > 5).astype(np.uint8), disc) == 0
    (person, near_person), (background, near_background) = (_spread(colours, part, reach) for part in (inner, outer))
    away = background - person
    square = np.square(away).sum(axis=2)
    share = ((colours - person) * away).sum(axis=2) / np.maximum(square, 1e-6)
    return Rim(share, away, near_person & near_background & (square > _DISTINCT**2)), inner


def _solid(matte: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    return (matte > 250).astype(np.uint8)


def _spread(colours: np.ndarray, part: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean colour of a part nearby, and where there is any."""
    weight = part.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), reach)
    mean = cv2.GaussianBlur(colours * weight[..., None], (0, 0), reach) / np.maximum(total, 1e-6)[..., None]
    return mean, total > 1e-3
