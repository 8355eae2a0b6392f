"""How many pairs of a tile and a splat the buffers of a GPU's drawing hold; its time and memory grow with that number.

The first drawing of a kind waits for its own count and fixes the capacity of all that follow: none of them waits, and one
that needs more is NaN. A checked drawing waits for its count too, and raises CannotDraw instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import torch

from avatar.compute.device import free_bytes
from avatar.splat.cpu import CannotDraw

MAX_PAIRS = 1 << 26  # 9 values of a record, and 9 of its moments, are found by int32: three tenths of what that reaches
HEADROOM = 4  # a head in the middle of the image needs a third of what it needs where it fills the image
PER_SPLAT, PER_TILE = 4, 64  # the least, where the first drawing shows little: what a head in the middle needs
BYTES = 8 + 4 + 8 + 8 + 16 + 36 + 4 + 36  # keys, splats, corners, order, to sort, a record, its place, its moments
_GRAIN = 4096


class Kind(NamedTuple):
    """Drawings that need about as many pairs."""

    device: torch.device
    splats: int
    tiles: int
    alpha_min: float
    features: int = 0  # channels


_fixed: dict[Kind, int] = {}
_checked: ContextVar[bool] = ContextVar("checked", default=False)


@contextmanager
def checked_drawings(checked: bool = True) -> Iterator[None]:
    """Drawings in here wait for the GPU, and raise CannotDraw where they could only be NaN otherwise; or do not."""
    token = _checked.set(checked)
    try:
        yield
    finally:
        _checked.reset(token)


def is_checked(device: torch.device) -> bool:
    return _checked.get() or device.type == "cpu"  # where Triton interprets, nothing is gained by not waiting


def capacity_of(kind: Kind, count: Callable[[], int]) -> int:
    """For a drawing that needs `count()` pairs, which is waited for. Raises CannotDraw where a checked one needs more than
    the capacity that its kind has."""
    if kind.device.type == "meta":  # nothing to count
        return most_pairs(kind)
    capacity = _fixed.get(kind)
    if capacity is not None and not is_checked(kind.device):
        return capacity
    needed = count()
    if capacity is None and is_checked(kind.device):
        return (needed // _GRAIN + 1) * _GRAIN
    if capacity is None:
        capacity = _fixed[kind] = capacity_with_headroom(kind, needed, free_bytes(kind.device))
    if needed > capacity:
        raise CannotDraw(
            f"drawing needs {needed} pairs of a tile and a splat, the GPU's buffers hold {capacity}; a lower --size or "
            "model.uv_size needs fewer"
        )
    return capacity


def capacity_with_headroom(kind: Kind, needed: int, free: float | None) -> int:
    """The capacity of a kind whose first drawing needs so many pairs; the headroom takes half of the free bytes at most."""
    wanted = max(HEADROOM * needed, PER_SPLAT * kind.splats + PER_TILE * kind.tiles)
    affordable = MAX_PAIRS if free is None else int(free / 2 / (BYTES + 4 * kind.features))
    return max(needed, 1, min(wanted, affordable, most_pairs(kind)))


def most_pairs(kind: Kind) -> int:
    """Of every splat in every tile."""
    return min(kind.splats * kind.tiles, MAX_PAIRS)
