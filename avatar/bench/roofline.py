"""An estimate of the least time that a function takes on this machine: counted work over the rates measured at this moment.

It is no bound. The rates are those of one matrix product and one copy, which another mix of instructions, or data that stay
in a cache, can exceed; and the counts are of one way of doing the work.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache

import torch

from avatar.bench.machine import limited_to

MATRIX = 1024  # side of the multiplied matrices
COPIED = 1 << 26  # bytes, far beyond the caches
ROUNDS = 25


@cache
def measured_flops(threads: int) -> float:
    """Floating-point operations a second of PyTorch's float32 matrix product."""
    a, b = torch.randn(MATRIX, MATRIX), torch.randn(MATRIX, MATRIX)
    return 2 * MATRIX**3 / _seconds(lambda: torch.mm(a, b), threads)


@cache
def measured_copy_bandwidth(threads: int) -> float:
    """Bytes a second, read and written ones counted, of copying a tensor that fits in no cache."""
    source = torch.ones(COPIED // 4)
    target = torch.empty_like(source)
    return 2 * COPIED / _seconds(lambda: target.copy_(source), threads)


def roofline_ms(operations: float, moved: float, threads: int) -> float:
    """Milliseconds for so many floating-point operations and moved bytes, whichever takes longer."""
    return 1e3 * max(operations / measured_flops(threads), moved / measured_copy_bandwidth(threads))


def _seconds(function: Callable[[], object], threads: int) -> float:
    spans = []
    with limited_to(threads=threads):
        for _ in range(ROUNDS):
            begin = time.perf_counter()
            function()
            spans.append(time.perf_counter() - begin)
    return min(spans)  # what else runs can only make a round slower
