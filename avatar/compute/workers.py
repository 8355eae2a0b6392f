"""Threads for independent work, each of which has one core."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch


@contextmanager
def single_threaded_workers(count: int) -> Iterator[ThreadPoolExecutor]:
    """`count` threads in each of which torch and the splatter use one core; other threads keep theirs."""
    before = torch.get_num_threads()
    all_run = threading.Barrier(count + 1)

    def settle() -> None:
        torch.get_num_threads()  # a thread's first use of torch sets its number to the process's: before, not after
        torch.set_num_threads(1)
        all_run.wait()

    with ThreadPoolExecutor(count, thread_name_prefix="worker") as pool:
        for _ in range(count):
            pool.submit(settle)
        all_run.wait()
        # torch sets the number for the calling thread and as the start value of threads to come: put that back.
        torch.set_num_threads(before)
        yield pool
