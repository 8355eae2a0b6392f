"""Independent work side by side, results in order: each piece by one thread, or one after the other on a GPU."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import TypeVar

from torch import Tensor

from avatar.compute.native import thread_count
from avatar.compute.workers import single_threaded_workers
from avatar.render import AHEAD_ON_GPU, AHEAD_PER_WORKER
from avatar.splat.gpu_buffers import checked_drawings

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """function(item) for every item, several at a time, a few of them ahead of the one that is asked for.

    The results do not depend on the number of threads. An exception is raised when its turn comes.
    """
    workers = thread_count()
    source = iter(items)
    pending: deque[Future[Result]] = deque()
    with single_threaded_workers(workers) as pool:
        try:
            while True:
                while len(pending) < AHEAD_PER_WORKER * workers and (item := next(source, None)) is not None:
                    pending.append(pool.submit(function, item))
                if not pending:
                    return
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


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
