"""Independent work side by side: each piece by one thread, results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import TypeVar

from avatar.compute.native import thread_count
from avatar.compute.workers import single_threaded_workers
from avatar.render import AHEAD_PER_WORKER

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
