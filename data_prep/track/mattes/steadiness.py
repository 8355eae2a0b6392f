"""How steady a clip's mattes are: how far the head's outline moves from frame to frame in coordinates that move with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from data_prep.track.mattes.alike_frames import laid_over

_FRAMES = 100  # that are looked at, at most, spread over the clip
_SIDE = 512  # pixels of the longer side, in which distances are given
_BESIDE, _ABOVE = 0.5, 0.5  # of the height of the mesh without its neck, beyond it: what is looked at
_SECOND = np.sqrt(6.0)  # deviation of a second difference of independent errors of deviation 1


class Outline(NamedTuple):
    """Means over frames, in pixels at a longer side of 512."""

    jitter: float  # sum of the matte's absolute second difference over time, divided by the outline's length
    width: float  # of the matte's soft edge


def measure_outline(
    numbers: Sequence[int],
    matte_of: Callable[[int], UInt8[np.ndarray, "H W"]],
    points_of: Callable[[int], Float[np.ndarray, "P 2"]],
) -> Outline | None:
    """The outline of the head above the chin; None where no three frames follow each other.

    points_of  the posed vertices of the head without the neck, pixels: their similarity transform brings a frame's
               neighbours into its own coordinates
    """
    known = set(numbers)
    middles = [number for number in numbers if {number - 1, number + 1} <= known]
    jitter, width = [], []
    for number in middles[:: -(-len(middles) // _FRAMES) or 1]:
        now, at = _share(matte_of(number)), points_of(number)
        moved = [laid_over(_share(matte_of(n)), points_of(n), at) for n in (number - 1, number + 1)]
        region = _about_head(at, *now.shape)
        slope = np.hypot(*np.gradient(cv2.GaussianBlur(now, (0, 0), 1.0)))
        length = max(float(slope[region].sum()), 1.0)  # of the line where the matte is half
        scale = _SIDE / max(now.shape) / length
        jitter.append(np.abs(moved[0] - 2.0 * now + moved[1])[region].sum() * scale / _SECOND)
        width.append(4.0 * (now * (1.0 - now))[region].sum() * scale)
    return Outline(float(np.mean(jitter)), float(np.mean(width))) if jitter else None


def _share(matte: UInt8[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    return matte.astype(np.float32) / 255.0


def _about_head(points: Float[np.ndarray, "P 2"], height: int, width: int) -> Bool[np.ndarray, "H W"]:
    low, high = points.min(axis=0), points.max(axis=0)
    side = high[1] - low[1]
    inside = np.zeros((height, width), bool)
    rows = np.clip([low[1] - _ABOVE * side, high[1]], 0, height).astype(int)
    columns = np.clip([low[0] - _BESIDE * side, high[0] + _BESIDE * side], 0, width).astype(int)
    inside[rows[0] : rows[1], columns[0] : columns[1]] = True
    return inside
