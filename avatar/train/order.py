"""Which training frame each step sees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np


def frame_order(frames: Sequence[int], seed: int, start: int, stop: int) -> Iterator[int]:
    """The frames of steps `start` to `stop` - 1: every pass over `frames` in a new random order.

    A pure function of the seed and the step, so that a resumed run sees the same frames as an uninterrupted one.
    """
    order: list[int] = []
    current = -1
    for step in range(start, stop):
        epoch, position = divmod(step, len(frames))
        if epoch != current:
            order = np.random.default_rng([seed, epoch]).permutation(len(frames)).tolist()
            current = epoch
        yield frames[order[position]]
