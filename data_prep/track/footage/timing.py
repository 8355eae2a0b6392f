"""The times of pictures on a regular grid: the rate that a tracked folder gets, and each picture's number in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

DEFAULT_FPS = 25.0
COMMON_RATES = (24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 15.0, 12.5, 12.0, 10.0, 20.0, 5.0, 1.0)
_SNAP = 0.005  # relative: what time stamps in whole milliseconds do to a regular rate
_SNAP_VARIABLE = 0.02
_DRIFT = 0.25  # pictures at the end, by which a usual rate may be off: with more it is another one
_MOST_OFF = 3.0  # places by which pictures may be off their numbers: with more, the rate changes slowly
_SLACK = 0.75  # places by which a picture may be off its number
_REGULAR = (0.5, 1.5)  # times the median distance, within which pictures are taken one by one


class Timing(NamedTuple):
    fps: float
    numbers: Int[np.ndarray, " T"]  # of each picture, increasing from 0; -1 where it is left out
    notes: tuple[str, ...]


def regular_timing(times: Float[np.ndarray, " T"], stated: float | None = None) -> Timing:
    """Give every picture a number so that its time is about number / fps, at most one picture to a number.

    Pictures that come regularly are numbered one by one. Of a variable rate the commonest one becomes the grid: of
    pictures that fall on one place the nearest stays, places without a picture stay empty, and nothing is shown twice.
    `stated` is the rate that the file names, for clips that are too short to tell.
    """
    T = len(times)
    if T < 3:
        return Timing(stated or DEFAULT_FPS, np.arange(T), ())
    steps = np.diff(times)
    forward = steps[steps > 1e-6]
    if len(forward) < T // 2:  # no time stamps to speak of
        fps = stated or DEFAULT_FPS
        note = f"the pictures carry no usable times: {fps:g} a second are assumed"
        return Timing(fps, np.arange(T), (note,))
    median = float(np.median(forward))
    low, high = (share * median for share in _REGULAR)
    if steps.min() >= low and steps.max() <= high:
        fps, slope = _common(float((T - 1) / (times[-1] - times[0]))), float(np.polyfit(np.arange(T), times, 1)[0])
        drift = (T - 1) * abs(slope * fps - 1)
        fps = fps if drift <= _DRIFT else 1 / slope
        if np.abs((times - times[0]) * fps - np.arange(T)).max() <= _MOST_OFF:
            return Timing(fps, np.arange(T), ())
    usual = forward[(forward > 0.8 * median) & (forward < 1.2 * median)]
    if len(usual) == 0:  # the median lies between two distances that are as common: the shorter one
        usual = np.sort(forward)[len(forward) // 2 - 1 :][:1]
    fps = _common(float(1.0 / usual.mean()), _SNAP_VARIABLE)
    places = np.maximum.accumulate(times - times[0]) * fps  # a time that runs backwards stays where it was
    numbers = _numbered(places)
    off = np.abs(places - numbers)
    starts = np.flatnonzero(np.r_[True, numbers[1:] != numbers[:-1]])
    for first, end in zip(starts, np.r_[starts[1:], T], strict=True):
        best = first + int(off[first:end].argmin())
        numbers[first:best] = numbers[best + 1 : end] = -1
    dropped = int((numbers < 0).sum())
    empty = int(numbers.max() + 1 - (T - dropped))
    note = (
        f"the frame rate varies ({1e3 * forward.min():.0f} to {1e3 * steps.max():.0f} ms from picture to picture): the "
        f"clip is taken at {fps:.4g} a second, {dropped} pictures between are left out and {empty} times have none"
    )
    return Timing(fps, numbers, (note,))


def _numbered(places: Float[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
    """Each picture's number, counted from the one before: behind a gap that is no whole number of places all pictures may
    lie halfway between two, and would fall on either."""
    numbers = np.zeros(len(places), np.int64)
    for n in range(1, len(places)):
        counted = numbers[n - 1] + round(places[n] - places[n - 1])
        numbers[n] = counted if abs(places[n] - counted) <= _SLACK else round(places[n])
    return numbers


def _common(fps: float, tolerance: float = _SNAP) -> float:
    """The rate itself, or the one of the usual rates that it is up to rounding."""
    nearest = min(COMMON_RATES, key=lambda rate: abs(rate - fps))
    return nearest if abs(nearest - fps) < tolerance * fps else fps
