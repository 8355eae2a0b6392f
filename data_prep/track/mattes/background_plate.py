"""What stands behind the person where the camera stands still: the clip's clean plate, and where a picture shows it.

The plate is every pixel's median over pictures in which a network sees nobody near. What shows it within the video's noise
is background, although the network may take it for the person: between locks of hair, behind an ear, beside glasses. It is
believed where the person beside it looks otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from data_prep.track.mattes.closed_form_matting import band_radius, limited

CLIP_FRAMES = 40  # that the plate is the median of
_SEEN = 3  # of these at least must show a pixel's background
_NOBODY = 12  # of 255: a network's matte below which nobody is there
# In radii of the band within which a network's edge errs (`matting.band_radius`):
_CLEAR = 3  # around the person, in which the background is not looked for
_CONTINUED = 3  # over which the background is taken to go on where it is smooth
_RESEMBLED = 12  # over which it is continued anyhow, to see whether the person looks like it
_ABOUT = 5  # the edge, where the plate is asked
_NOISE = 2.2  # medians of the deviations: 1.5 are a normal distribution's standard deviation, whose tails are thinner
_SMOOTH = 2.0  # times the noise: differences of a smooth part
_SAME, _OTHER = 2.0, 3.0  # times the noise: within, background; beyond, something else
_STILL = 0.05  # share of the background that may look like something else: with more, the camera moves
_BELIEVED = 0.05  # share of the person nearby that may look like the background


class Plate(NamedTuple):
    """Of pictures at the size at which they are matted (`matting.limited`)."""

    colours: Float32[np.ndarray, "h w 3"]  # levels of 255
    known: Bool[np.ndarray, "h w"]  # seen, or beside a smooth part that was
    guessed: Bool[np.ndarray, "h w"]  # known, or not far from it
    noise: float  # levels


def learn_plate(frames: Iterable[tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]]) -> Plate | None:
    """From pictures of a clip and a network's mattes; None where the camera moves, or where too little is seen."""
    pictures, empty = [], []
    for image, matte in frames:
        somebody = limited(matte) > _NOBODY
        pictures.append(limited(image))
        empty.append(~dilated(somebody, _CLEAR * band_radius(*somebody.shape)))
    if len(pictures) < _SEEN:
        return None
    seen = np.sum(empty, axis=0) >= _SEEN
    few = np.s_[::2, ::2]  # every fourth pixel tells the noise as well
    if not seen[few].any():
        return None
    radius = band_radius(*seen.shape)
    median = _median(np.stack(pictures), np.stack(empty)).astype(np.float32)
    parts = [part & seen for part in empty]
    away = [np.abs(p[few] - median[few])[part[few]] for p, part in zip(pictures, parts, strict=True)]
    noise = max(_NOISE * float(np.median(np.concatenate(away))), 1.0)
    colours, differ = _continued(median, seen, _CONTINUED * radius)
    known = seen | (differ < _SMOOTH * noise)
    colours, differ = _continued(colours, known, _RESEMBLED * radius)
    plate = Plate(colours, known, known | np.isfinite(differ), noise)
    others = (
        np.count_nonzero(_distance(plate, picture)[part] > _OTHER)
        for picture, part in zip(pictures, parts, strict=True)
    )
    return plate if sum(others) <= _STILL * sum(map(np.count_nonzero, parts)) else None


def shown(plate: Plate, image: UInt8[np.ndarray, "h w 3"], person: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where a picture shows the plate, about the edge of what a network takes for the `person`."""
    radius = band_radius(*person.shape)
    inside = ~dilated(~person, _ABOUT * radius)
    same = _distance(plate, image) < _SAME
    about = ~inside & dilated(person, _ABOUT * radius)
    return about & plate.known & same & _rare(same, inside & plate.guessed, radius)


def _median(pictures: UInt8[np.ndarray, "T h w 3"], parts: Bool[np.ndarray, "T h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Each pixel's median over the pictures of whose `parts` it is; white where there is none. Overwrites `pictures`."""
    pictures[~parts] = 255  # the last in order
    pictures.sort(axis=0)
    middle = np.maximum(parts.sum(axis=0) - 1, 0) // 2
    return np.take_along_axis(pictures, middle[None, ..., None], axis=0)[0]


def _continued(
    colours: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], radius: int
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """The colours, those of what is not known from nearby, and how much the known ones differ there, in levels."""
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), radius)
    own = np.where(known[..., None], colours, np.float32(0.0))
    mean, square = (
        cv2.GaussianBlur(values, (0, 0), radius) / np.maximum(weight, 1e-6)[..., None] for values in (own, own * own)
    )
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0).mean(axis=2))
    spread[weight < 0.01] = np.inf
    return np.where(known[..., None], own, mean), spread


def _distance(plate: Plate, image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """How far the colours about each pixel are from the plate's, in units of the noise."""
    return np.sqrt(cv2.blur(np.square((image - plate.colours) / plate.noise).mean(axis=2), (3, 3)))


def _rare(what: Bool[np.ndarray, "h w"], within: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    """Where some of the neighbourhood lies `within`, and hardly any of that is `what`."""
    size = (4 * _ABOUT * radius + 1,) * 2
    total, found = (cv2.blur(part.astype(np.float32), size) for part in (within, what & within))
    return (total > 0) & (found <= _BELIEVED * total)


def dilated(mask: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0
