"""Launches that a GPU repeats by itself: to start a kernel takes the host longer than most of ours run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, TypeVar

import torch
from torch import Tensor

Made = TypeVar("Made")


class Replay(Generic[Made]):
    """A function of tensors, captured as a CUDA graph, which is started with other values in one launch.

    Whatever else the function reads must stay where it is, and it may neither wait for the GPU nor bring it anything. What
    it gives is overwritten by the next start. To be captured it is called, but nothing runs; that takes a stream of one's
    own (`own_stream`), on which it has run before. Where there is no GPU it is called at each start instead, for tests.
    """

    def __init__(self, function: Callable[[Sequence[Tensor]], Made], inputs: Sequence[Tensor]) -> None:
        self._buffers = [tensor.detach().clone(memory_format=torch.contiguous_format) for tensor in inputs]
        self._function = function
        self._graph: torch.cuda.CUDAGraph | None = None
        if self._buffers[0].is_cuda:
            graph = torch.cuda.CUDAGraph()
            # Other threads, which decode frames, may do what they like.
            with torch.cuda.graph(graph, stream=torch.cuda.current_stream(), capture_error_mode="thread_local"):
                self._made = function(self._buffers)
            self._graph = graph

    def __call__(self, inputs: Sequence[Tensor]) -> Made:
        """With tensors of the shapes, types and device of the first ones."""
        fast = [(ours, given) for ours, given in zip(self._buffers, inputs, strict=True) if ours.dtype == torch.float32]
        torch._foreach_copy_([ours for ours, _ in fast], [given for _, given in fast])  # pyright: ignore
        for ours, given in zip(self._buffers, inputs, strict=True):
            if ours.dtype != torch.float32:
                ours.copy_(given)
        if self._graph is None:
            return self._function(self._buffers)
        self._graph.replay()
        return self._made


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """What is launched in here comes after what was launched before, and before what comes after; from a stream of one's
    own can be captured."""
    if device.type != "cuda":
        yield
        return
    outside, stream = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    stream.wait_stream(outside)
    with torch.cuda.stream(stream):
        yield
    outside.wait_stream(stream)
