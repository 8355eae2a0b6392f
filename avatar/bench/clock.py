"""Timing of several functions against each other on a machine that is never quite quiet."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch

Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class Time:
    """Milliseconds of one call."""

    median: float
    p95: float  # the 95th percentile
    repeats: int

    def __str__(self) -> str:
        return f"{self.median:.2f} ({self.p95:.2f})"


def paired_medians(
    functions: Mapping[Name, Callable[[], object]], repeats: int, *, warm_up: int = 1
) -> dict[Name, Time]:
    """Call all functions in turns, in their order, `warm_up` + `repeats` rounds, of which the first are not counted.

    Taking turns lets a disturbance of the machine meet all of them alike, so that ratios can be trusted further than the
    times themselves. What a function returns is dropped outside the measured span.
    """
    spans: dict[Name, list[float]] = {name: [] for name in functions}
    for turn in range(-warm_up, repeats):
        for name, function in functions.items():
            begin = time.perf_counter()
            result = function()
            span = 1e3 * (time.perf_counter() - begin)
            del result
            if turn >= 0:
                spans[name].append(span)
    return {name: time_of(values) for name, values in spans.items()}


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done all that was launched."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def time_of(milliseconds: Sequence[float]) -> Time:
    """Median and 95th percentile of measured times."""
    ordered = sorted(milliseconds)
    return Time(statistics.median(ordered), ordered[round(0.95 * (len(ordered) - 1))], len(ordered))
