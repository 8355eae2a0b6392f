"""Colours behind a head, as people write them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

Colour = tuple[float, float, float]  # red, green, blue in [0, 1]

COLOURS: dict[str, Colour] = {
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}
COLOUR_WORDS = f"a colour: {', '.join(COLOURS)}, #rrggbb, or three numbers from 0 to 1 such as [1,0.5,0]"
_HEX = re.compile(r"#([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})")


def parse_colour(value: Any) -> Colour:
    """A colour from its name, `#rrggbb`, a list of three numbers in [0, 1], or those as text ("1,0.5,0").

    Raises ValueError for anything else.
    """
    if isinstance(value, str):
        name = value.strip().lower()
        if name in COLOURS:
            return COLOURS[name]
        if match := _HEX.fullmatch(name):
            return _three([int(digits, 16) / 255.0 for digits in match.groups()])
        return _three([float(part) for part in name.strip("[]()").split(",")])
    if isinstance(value, list | tuple) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        return _three([float(v) for v in value])
    raise ValueError(f"{value!r} is not a colour")


def colour_name(colour: Sequence[float]) -> str:
    """What `parse_colour` reads: the name where there is one, else the three numbers."""
    return next((name for name, own in COLOURS.items() if own == tuple(colour)), f"[{','.join(map(str, colour))}]")


def _three(values: Sequence[float]) -> Colour:
    if len(values) != 3 or not all(math.isfinite(value) and 0.0 <= value <= 1.0 for value in values):
        raise ValueError(f"{list(values)} are not three numbers from 0 to 1")
    return values[0], values[1], values[2]
