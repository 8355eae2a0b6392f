"""Values of JSON files, which may be anything."""

from __future__ import annotations

import sys
from typing import Any


def parse_number(value: Any, name: str) -> float:
    """A finite number. Raises ValueError naming it."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name} is not a finite number")
    return float(value)


def parse_intrinsics(values: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy. Raises TypeError or ValueError."""
    if not isinstance(values, list):
        raise TypeError(f"intrinsics is a {type(values).__name__}, not a list")
    if len(values) != 4:
        raise ValueError(f"intrinsics has {len(values)} values, not 4")
    fx, fy, cx, cy = (parse_number(v, "intrinsics") for v in values)
    return fx, fy, cx, cy


def parse_positions(values: Any, key: str, count: int) -> tuple[int, ...]:
    """A list of positions among `count` frames, not empty. Raises TypeError or ValueError naming `key`."""
    if not isinstance(values, list):
        raise TypeError(f"{key} is a {type(values).__name__}, not a list")
    if not values or not all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < count for v in values):
        raise ValueError(f"{key} is empty or names frames outside the {count} of the subject")
    return tuple(values)
