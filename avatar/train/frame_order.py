"""How many steps there are, and which training frame each of them sees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from avatar.config import TrainerConfig


def within_epochs(config: TrainerConfig, frames: int) -> TrainerConfig:
    """The same with no more iterations than `max_epochs` passes over so many training frames take."""
    if config.max_epochs is None:
        return config
    return replace(config, iterations=min(config.iterations, config.max_epochs * frames))


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
