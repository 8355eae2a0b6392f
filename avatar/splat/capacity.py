"""How many pairs of a tile and a splat the GPU's buffers hold: chosen without waiting for the GPU, and loud when too small.

The first drawing of a kind waits once for its number. After each drawing the number comes back when it comes; the next
drawing that finds it there makes room for half as many again. Too little room makes the drawing NaN, and the next one large
enough. On a CPU, where Triton interprets the kernels for tests, every drawing waits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from avatar.types import Rendering

# 9 values of a record, and 9 of its moments, are found by int32: three tenths of what that reaches.
MAX_PAIRS = 1 << 26
ROOM = 1.5  # as much as the drawings so far needed
FULL = 0.75  # part of the capacity from which on it grows
_GRAIN = 4096


class Kind(NamedTuple):
    """Drawings that need about as many pairs."""

    device: torch.device
    splats: int
    tiles: int


@dataclass
class _Pending:
    """A number on its way to the host."""

    number: Tensor
    arrived: torch.cuda.Event


class Capacities:
    """The capacities of this process, by kind of drawing."""

    def __init__(self) -> None:
        self._pairs: dict[Kind, int] = {}
        self._pending: dict[Kind, _Pending] = {}
        self._lock = threading.Lock()
        self.fixed: int | None = None
        self.last_kind: Kind  # of the last drawing, as `watch` was told of it
        self.last_ends: Int[Tensor, " N"]

    def known(self, kind: Kind) -> int | None:
        """What the next drawing of this kind is to use; None: it has to wait for its own number."""
        if self.fixed is not None:
            return self.fixed
        if kind.device.type == "cpu":
            return None
        with self._lock:
            pending = self._pending.get(kind)
            if pending is not None and pending.arrived.query():
                self._grow(kind, int(self._pending.pop(kind).number[0]))
            return self._pairs.get(kind)

    def learn(self, kind: Kind, needed: int) -> int:
        """Make room for a drawing that needs so many pairs; gives the capacity."""
        with self._lock:
            self._pairs[kind] = roomy(needed)
            return self._pairs[kind]

    def forget(self) -> None:
        """Let the next drawing of each kind wait for its number."""
        with self._lock:
            self._pairs.clear()
            self._pending.clear()

    def watch(self, kind: Kind, ends: Int[Tensor, " N"]) -> None:
        """Let the number of pairs of a drawing, the last of `ends`, come back when the GPU gets there."""
        self.last_kind, self.last_ends = kind, ends
        if self.fixed is not None or kind.device.type != "cuda":
            return
        with self._lock:
            if kind in self._pending:
                return
            number = torch.empty(1, dtype=torch.int64, pin_memory=True)
            number.copy_(ends[-1:], non_blocking=True)
            arrived = torch.cuda.Event()
            arrived.record()
            self._pending[kind] = _Pending(number, arrived)

    def _grow(self, kind: Kind, needed: int) -> None:
        """`needed` above MAX_PAIRS: a value that was not finite, or scales beyond reason; room would not help."""
        if FULL * self._pairs[kind] < needed <= MAX_PAIRS:
            self._pairs[kind] = roomy(needed)


def roomy(needed: int) -> int:
    """Room for half as many again, and for some where none are needed."""
    return min((round(ROOM * needed) // _GRAIN + 1) * _GRAIN, MAX_PAIRS)


CAPACITIES = Capacities()


def with_room(draw: Callable[[], Rendering]) -> Rendering:
    """What `draw` gives, waited for; where the buffers of a GPU were too small, drawn again with room for everything."""
    rendering = draw()
    if rendering.alpha.is_cuda and bool(rendering.alpha.isnan().any()):
        CAPACITIES.forget()
        rendering = draw()
    return rendering


@contextmanager
def fixed_capacity(pairs: int) -> Iterator[None]:
    """Draw with room for exactly so many pairs: nothing is waited for, and a CUDA graph may capture the drawing."""
    before = CAPACITIES.fixed
    CAPACITIES.fixed = pairs
    try:
        yield
    finally:
        CAPACITIES.fixed = before
