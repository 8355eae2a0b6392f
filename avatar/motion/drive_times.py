"""How many frames a second a table of motion has, by its columns of times."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from avatar.errors import UserError
from avatar.motion.csv_table import Table, own_name

_TIMECODE = re.compile(r"(\d{1,4}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:[.,]\d{1,9})?)")  # hours, minutes, seconds, frames
_CLOCK = re.compile(r"(?:(\d{1,4}):)?(\d{1,6}):(\d{1,2}[.,]\d{1,9})")  # hours, minutes, seconds with a fraction
_WORDS = {
    "s|secs?|seconds?": ("seconds", 1.0),
    "ms|msecs?|millis|milliseconds?": ("milliseconds", 1e-3),
    "us|usecs?|micros|microseconds?": ("microseconds", 1e-6),
    "ns|nsecs?|nanos|nanoseconds?": ("nanoseconds", 1e-9),
}
UNITS = dict(_WORDS.values())
_NAME = re.compile(r"(?:timecode|timestamp|time)(?:in)?(?P<unit>[a-z]*)|(?P<alone>seconds|milliseconds|ms)")
USUAL_RATES = (24, 25, 30, 48, 50, 60, 90, 100, 120, 240)  # of timecodes
PLAUSIBLE = (5.0, 250.0)  # frames a second, by which the unit is found: no two units can fit
BOUNDS = (1.0, 1000.0)  # frames a second, where the unit is said
LATEST = 1e20  # nanoseconds since 1970 are below
DAY = 86_400.0
GAP = 1.5  # of the usual step: a longer one is a gap
SAID_GAP = 0.2  # seconds in all
DRIFT, ROUNDING = 0.01, 2e-4  # by which timecodes with parts of frames, and other times, miss a rate
SHARE_AT_ONCE = 0.1  # of the steps that may take no time


class Rate(NamedTuple):
    fps: float
    source: str  # for people


class _Times(NamedTuple):
    seconds: np.ndarray
    source: str
    bounds: tuple[float, float]
    counted: int | None = None  # frames a second, by timecodes


def is_time(name: str) -> bool:
    """Whether a column of this name holds times."""
    match = _NAME.fullmatch(own_name(name))
    return match is not None and (not match["unit"] or _unit(match["unit"]) is not None)


def find_rate(table: Table, say: Callable[[str], None]) -> Rate | None:
    """By the columns of times; None where there is none, or a single frame. Says where times have gaps.

    Raises UserError naming the column for times that do not rise or may mean several rates, and columns that disagree.
    """
    names = [name for name in table.header if is_time(name)]
    if not names or len(table) < 2:
        return None
    rates = [_rate(table, name, _read(table, name), say if name == names[0] else lambda _: None) for name in names]
    for name, rate in zip(names[1:], rates[1:], strict=True):
        if abs(rate.fps / rates[0].fps - 1.0) > 0.05:
            raise UserError(
                f"{table.path}: the columns {names[0]} and {name} give {rates[0].fps:g} and {rate.fps:g} frames a second; "
                "take one of them out"
            )
    return rates[0]


def _read(table: Table, name: str) -> _Times:
    cells = table.cells(name)
    if all(_TIMECODE.fullmatch(cell) for cell in cells):
        return _timecodes(table, name, cells)
    if all(_CLOCK.fullmatch(cell) for cell in cells):
        matches = [match for cell in cells if (match := _CLOCK.fullmatch(cell))]
        seconds = [3600.0 * int(m[1] or 0) + 60.0 * int(m[2]) + float(m[3].replace(",", ".")) for m in matches]
        return _Times(_unwrapped(seconds), f"its column {name}", BOUNDS)
    if ":" in cells[0]:
        form = _CLOCK if _CLOCK.fullmatch(cells[0]) else _TIMECODE
        wrong = next(i for i, cell in enumerate(cells) if not form.fullmatch(cell))
        raise table.wrong(wrong, name, "not a time such as 10:00:00:24 (with frames) or 10:00:00.960")
    values = table.column(name, LATEST)
    match = _NAME.fullmatch(own_name(name))
    named = _unit(match["unit"] or match["alone"] or "") if match else None
    unit = named or _told_unit(table, name, values)
    bounds = BOUNDS if named else PLAUSIBLE
    return _Times((values - values[0]) * UNITS[unit], f"its column {name}, {unit}", bounds)


def _timecodes(table: Table, name: str, cells: list[str]) -> _Times:
    matches = [match for cell in cells if (match := _TIMECODE.fullmatch(cell))]
    seconds = _unwrapped([3600.0 * int(m[1]) + 60.0 * int(m[2]) + int(m[3]) for m in matches])
    frames = np.array([float(m[4].replace(",", ".")) for m in matches])
    counted = _counted(seconds, frames)
    if counted is None:
        raise UserError(
            f"{table.path}: the column {name} does not tell how many frames a second has ({cells[0]} to {cells[-1]}); "
            "give a column time_s, in seconds, in its place"
        )
    return _Times(seconds - seconds[0] + frames / counted, f"its column {name}", BOUNDS, counted)


def _counted(seconds: np.ndarray, frames: np.ndarray) -> int | None:
    """How many frames a second the timecodes count: what the frames' number falls by from one second to the next."""
    passed, steps = np.diff(seconds), np.diff(frames)
    within = steps[(passed == 0) & (steps > 0)]
    if not len(within):
        return None
    step = float(np.median(within))
    found = [round(value) for value in (frames[:-1] + step - frames[1:])[passed == 1]]
    if not found:
        return None
    counted = max(found)  # fewer where frames are lost just there
    is_told = counted in USUAL_RATES or found.count(counted) > 1
    return counted if is_told and counted > int(frames.max()) else None


def _told_unit(table: Table, name: str, values: np.ndarray) -> str:
    """Of times whose column does not name one: that in which the frames come at a plausible rate."""
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for unit, seconds in UNITS.items():
        if 1.0 / PLAUSIBLE[1] <= step * seconds <= 1.0 / PLAUSIBLE[0]:
            return unit
    if step <= 0:
        raise UserError(f"{table.path}: the column {name} must rise from line to line")
    raise UserError(
        f"{table.path}: the column {name} rises by {step:g} a line, which is no usual frame rate in seconds or in "
        f"milliseconds; call it {name}_s or {name}_ms if it is right, or take it out if it counts frames"
    )


def _rate(table: Table, name: str, times: _Times, say: Callable[[str], None]) -> Rate:
    steps = np.diff(times.seconds)
    if (steps < 0).any() or (steps == 0).mean() > SHARE_AT_ONCE:
        row = int((steps < 0).argmax() if (steps < 0).any() else (steps == 0).argmax()) + 1
        raise table.wrong(row, name, f"but the column {name} must rise from line to line")
    usual = float(np.median(steps[steps > 0]))
    gaps = steps > GAP * usual
    mean = float(steps[~gaps].mean())
    fps = 1.0 / mean if mean > 0 else np.inf
    low, high = times.bounds
    if not low * (1 - DRIFT) <= fps <= high * (1 + DRIFT):
        raise UserError(
            f"{table.path}: by the column {name} there are {fps:g} frames a second; its times are of another unit, or "
            "no times"
        )
    usual_fps = times.counted / max(1, round(times.counted / fps)) if times.counted else round(fps)
    if abs(fps - usual_fps) < (DRIFT if times.counted else ROUNDING) * fps:
        fps = float(usual_fps)
    lost = float((steps[gaps] - usual).sum())
    if lost > SAID_GAP:
        line = table.lines[int(steps.argmax()) + 1]
        say(
            f"Note: {table.path.name} has gaps in its column {name}, {lost:.1f} s in all, the longest before line {line}; "
            "the motion goes on without them"
        )
    return Rate(min(max(fps, BOUNDS[0]), BOUNDS[1]), times.source)


def _unwrapped(seconds: list[float]) -> np.ndarray:
    """Times of the day that go on after midnight."""
    values = np.array(seconds)
    return values + DAY * np.concatenate(([0.0], np.cumsum(np.diff(values) < -DAY / 2)))


def _unit(word: str) -> str | None:
    return next((unit for words, (unit, _) in _WORDS.items() if re.fullmatch(words, word)), None)
