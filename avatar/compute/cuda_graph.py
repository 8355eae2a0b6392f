"""Launches that a GPU repeats by itself: to start a kernel takes the host longer than most of ours run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

Made = TypeVar("Made")
Pool = Any  # torch's handle of memory


def new_pool(device: torch.device) -> Pool | None:
    """Memory for the intermediate values of several replays."""
    return torch.cuda.graph_pool_handle() if device.type == "cuda" else None


class Replay(Generic[Made]):
    """A function of tensors, captured as a CUDA graph, which is started with other values in one launch.

    Whatever else the function reads must stay where it is, and it may neither wait for the GPU nor bring it anything. What
    it gives is overwritten by the next start. To be captured it is called, but nothing runs; that takes a stream of one's
    own (`own_stream`), on which it has run before. Where there is no GPU it is called at each start instead, for tests.

    Replays that are made with one `pool` share their memory: what one gives must be used before another starts.
    """

    def __init__(
        self, function: Callable[[Mapping[str, Tensor]], Made], inputs: Mapping[str, Tensor], pool: Pool | None = None
    ) -> None:
        self._buffers = {
            name: tensor.detach().clone(memory_format=torch.contiguous_format) for name, tensor in inputs.items()
        }
        self._function = function
        self._graph: torch.cuda.CUDAGraph | None = None
        if next(iter(self._buffers.values())).is_cuda:
            graph = torch.cuda.CUDAGraph()
            # Other threads, which decode frames, may do what they like.
            own = torch.cuda.current_stream()
            with torch.cuda.graph(graph, pool=pool, stream=own, capture_error_mode="thread_local"):
                self._made = function(self._buffers)
            self._graph = graph

    def __call__(self, inputs: Mapping[str, Tensor]) -> Made:
        """With tensors of the names, shapes, types and device of the first ones."""
        by_type: dict[torch.dtype, list[tuple[Tensor, Tensor]]] = {}
        for name, buffer in self._buffers.items():
            by_type.setdefault(buffer.dtype, []).append((buffer, inputs[name]))
        for copies in by_type.values():
            torch._foreach_copy_(*map(list, zip(*copies, strict=True)))  # pyright: ignore
        if self._graph is None:
            return self._function(self._buffers)
        self._graph.replay()
        return self._made


class Downloads:
    """Copies to the CPU, made while a GPU goes on."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)

    def begin(self, tensor: Tensor) -> tuple[Tensor, torch.cuda.Event]:
        """The copy, and what is to be waited for before it is read."""
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            copy, arrived = tensor.to("cpu", non_blocking=True), torch.cuda.Event()
            arrived.record()
        tensor.record_stream(self._stream)
        return copy, arrived


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
