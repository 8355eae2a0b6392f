"""The options of a drawing, and the part of the image that it is limited to."""

from __future__ import annotations

from operator import index
from typing import Any, NamedTuple


class Region(NamedTuple):
    """Columns `left` to `right` - 1 and rows `top` to `bottom` - 1; not empty."""

    left: int
    top: int
    right: int
    bottom: int


class Options(NamedTuple):
    """Those of `avatar.splat.splat`, which says what each means."""

    sh_degree: int | None  # once checked, None for features alone
    alpha_min: float
    alpha_max: float
    t_min: float
    blur: float
    near: float
    antialiased: bool
    region: Region


def check_region(region: Any, width: int, height: int) -> Region:
    """The pixels of `region`, a pair (rows, columns) of slices or None for the whole image; TypeError, ValueError."""
    if region is None:
        return Region(0, 0, width, height)
    if not (isinstance(region, tuple) and len(region) == 2 and all(isinstance(part, slice) for part in region)):
        raise TypeError(f"region must be a pair of slices (rows, columns) or None, got {region!r}")
    top, bottom = _bounds("rows", region[0], height)
    left, right = _bounds("columns", region[1], width)
    return Region(left, top, right, bottom)


def _bounds(name: str, part: slice, size: int) -> tuple[int, int]:
    try:
        first = 0 if part.start is None else index(part.start)
        end = size if part.stop is None else index(part.stop)
        step = 1 if part.step is None else index(part.step)
    except TypeError:
        raise TypeError(f"the {name} of region must be a slice of whole numbers, got {part}") from None
    if step != 1:
        raise ValueError(f"the {name} of region must be consecutive, got {part}")
    if not 0 <= first < end <= size:
        raise ValueError(f"the {name} of region must be one or more within 0 to {size}, got {first} to {end}")
    return first, end
