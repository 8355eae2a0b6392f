"""Threads for independent work, each of which has one core."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2  # pieces of work of each thread that are begun before the first of them is asked for


def in_order(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """function(item) for every item, by `workers` threads, a few of them ahead of the one that is asked for.

    `items` may be endless. The results do not depend on the number of threads. An exception is raised when its turn comes.
    """
    source = iter(items)
    pending: deque[Future[Result]] = deque()
    with single_threaded_workers(workers) as pool:
        try:
            while True:
                while len(pending) < AHEAD * workers and (item := next(source, None)) is not None:
                    pending.append(pool.submit(function, item))
                if not pending:
                    return
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


@contextmanager
def single_threaded_workers(count: int) -> Iterator[ThreadPoolExecutor]:
    """`count` threads in each of which torch and the splatter use one core; other threads keep theirs."""
    before = torch.get_num_threads()
    all_run = threading.Barrier(count + 1)

    def use_one_thread() -> None:
        torch.get_num_threads()  # a thread's first use of torch sets its number to the process's: before, not after
        torch.set_num_threads(1)
        all_run.wait()

    with ThreadPoolExecutor(count, thread_name_prefix="worker") as pool:
        for _ in range(count):
            pool.submit(use_one_thread)
        all_run.wait()
        # torch sets the number for the calling thread and as the start value of threads to come: put that back.
        torch.set_num_threads(before)
        yield pool
