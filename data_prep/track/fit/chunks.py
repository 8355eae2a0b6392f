"""Frames are independent in most of the fit: parts of a clip side by side, each computed by one thread.

The fit's matrices are small. torch's own threads, which share each product, wait for each other longer than they work
as soon as another program wants a core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

from avatar.compute.native import thread_count
from avatar.compute.workers import single_threaded_workers

Made = TypeVar("Made")

_workers: ContextVar[ThreadPoolExecutor | None] = ContextVar("workers", default=None)


@contextmanager
def side_by_side() -> Iterator[None]:
    """Inside, `over_chunks` has a thread for each core that torch had, and every operation of torch has one."""
    before = torch.get_num_threads()
    with single_threaded_workers(thread_count()) as pool:
        token = _workers.set(pool)
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
            _workers.reset(token)


def chunks_of(frames: int, at_once: int) -> Iterator[slice]:
    """The frames in order, in slices of `at_once` and a rest."""
    for start in range(0, frames, at_once):
        yield slice(start, min(start + at_once, frames))


def over_chunks(function: Callable[[slice], Made], frames: int, at_once: int) -> list[Made]:
    """function(chunk) of all chunks in order; the calls run side by side where that is on, and must not meet."""
    pool, chunks = _workers.get(), chunks_of(frames, at_once)
    return list(map(function, chunks) if pool is None else pool.map(function, chunks))
