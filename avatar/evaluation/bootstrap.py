"""Confidence intervals of means over the frames of a video.

Neighbouring frames resemble each other, so drawing single frames with replacement would make the intervals too narrow.
The moving-block bootstrap draws runs of successive frames instead. Source: Künsch, "The jackknife and the bootstrap for
general stationary observations", Annals of Statistics 17 (1989); percentile intervals.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
SEED = 0
LEVEL = 0.95
BLOCK_SECONDS = 1.0

Interval = tuple[float, float]


def block_length(count: int, fps: float) -> int:
    """Frames in a block: one second, at most a quarter of the frames, at least one."""
    return max(1, min(round(BLOCK_SECONDS * fps), count // 4))


class BlockBootstrap:
    """`RESAMPLES` draws of `count` frames in blocks of `block`, the same ones for every figure."""

    def __init__(self, count: int, block: int) -> None:
        generator = np.random.default_rng(SEED)
        starts = generator.integers(0, count - block + 1, size=(RESAMPLES, math.ceil(count / block)))
        frames = (starts[:, :, None] + np.arange(block)).reshape(RESAMPLES, -1)[:, :count]
        cells = frames + count * np.arange(RESAMPLES)[:, None]
        weights = np.bincount(cells.ravel(), minlength=RESAMPLES * count)
        self._weights = weights.reshape(RESAMPLES, count).astype(np.float64)  # how often a resample holds a frame

    def interval(self, values: Float[np.ndarray, " count"]) -> Interval | None:
        """Where the mean over the frames that have a finite value lies with `LEVEL`; None for fewer than two of them."""
        finite = np.isfinite(values)
        if finite.sum() < 2:
            return None
        counts = self._weights @ finite
        sums = self._weights @ np.where(finite, values, 0.0)
        means = sums[counts > 0] / counts[counts > 0]
        low, high = np.quantile(means, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
        return float(low), float(high)


def describe(block: int) -> dict[str, object]:
    """For results files."""
    return {
        "method": "moving-block bootstrap over frames, percentile interval of the mean",
        "level": LEVEL,
        "block_frames": block,
        "resamples": RESAMPLES,
        "seed": SEED,
    }
