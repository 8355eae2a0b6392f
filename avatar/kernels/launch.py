"""The one place where kernels start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

Watcher = Callable[[Any, tuple[int, ...], tuple[Any, ...], dict[str, Any]], None]
_watchers: list[Watcher] = []


def start(kernel: Any, programs: int, *arguments: Any, warps: int, **constants: Any) -> None:
    """Run `programs` programs of a kernel on its arguments' device, in the order of the device's current stream.

    Products and sums are not fused behind the source's back: forward and backward pass, and all backends, must round alike.
    On the meta device, where tensors have no values, nothing runs.
    """
    for watch in _watchers:
        watch(kernel, (programs,), arguments, {**constants, "num_warps": warps})
    tensors = [argument for argument in arguments if isinstance(argument, Tensor)]
    if programs == 0 or tensors[0].is_meta:
        return
    if tensors[0].is_cuda and tensors[0].device.index != torch.cuda.current_device():
        with torch.cuda.device(tensors[0].device):
            _run(kernel, programs, arguments, warps, constants)
    else:
        _run(kernel, programs, arguments, warps, constants)


def _run(kernel: Any, programs: int, arguments: tuple[Any, ...], warps: int, constants: dict[str, Any]) -> None:
    kernel[(programs,)](*arguments, num_warps=warps, num_stages=1, enable_fp_fusion=False, **constants)


@contextmanager
def watched(watch: Watcher) -> Iterator[None]:
    """Tell `watch` of every start: the kernel, its grid, arguments and constants."""
    _watchers.append(watch)
    try:
        yield
    finally:
        _watchers.remove(watch)
