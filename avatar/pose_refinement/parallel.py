"""Independent frames side by side, results in order: each by one thread, or one after the other on a GPU."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from torch import Tensor

from avatar.compute.native import thread_count
from avatar.compute.workers import in_order
from avatar.render import AHEAD_ON_GPU
from avatar.splat import checked_drawings

Item = TypeVar("Item")


def each_in_order(
    function: Callable[[Item], Tensor | None], items: Iterable[Item], *, on_gpu: bool
) -> Iterator[Tensor | None]:
    """function(item) for every item, on the CPU, in order."""
    return read_later(function, items) if on_gpu else in_order(function, items, thread_count())


def read_later(begin: Callable[[Item], Tensor | None], items: Iterable[Item]) -> Iterator[Tensor | None]:
    """begin(item) for every item, brought to the CPU a few items later: a GPU has work while somebody waits for it.

    Where a NaN comes back, the item is begun again with checked drawings: raises CannotDraw if one of them is to blame.
    """
    pending: deque[tuple[Item, Tensor | None]] = deque()

    def arrived() -> Tensor | None:
        item, begun = pending.popleft()
        found = None if begun is None else begun.cpu()
        if found is not None and bool(found.isnan().any()):
            with checked_drawings():
                begin(item)
        return found

    for item in items:
        pending.append((item, begin(item)))
        if len(pending) > AHEAD_ON_GPU:
            yield arrived()
    while pending:
        yield arrived()
