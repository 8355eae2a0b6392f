"""How the GPU's kernels run without a GPU: Triton's interpreter, made quick enough for tests, or hostile to mistakes.

A process that interprets has TRITON_INTERPRET=1 from its start (make gpu-check). Where there is a GPU the tests that use
this run on it, and nothing here has an effect.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partialmethod
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from avatar.compute.device import interpreted

HAS_GPU = torch.cuda.is_available()
RUNS_KERNELS = interpreted() or HAS_GPU
DEVICE = torch.device("cuda" if HAS_GPU and not interpreted() else "cpu")
REASON = "needs a GPU, or Triton's interpreter (make gpu-check)"


@contextmanager
def quick_interpreter(patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Wide steps, because the interpreter takes time for each operation however many numbers it is about."""
    if not interpreted():
        yield
        return
    import triton.language as tl
    from triton.runtime import interpreter

    from avatar.gaussians import fused_gaussians_gpu
    from avatar.losses import gpu as losses_gpu
    from avatar.splat import gpu_draw
    from avatar.train import adam_gpu

    lanes = {"lanes": 1024, "backward_lanes": 1024, "summed": 256, "summed_lanes": 4}
    wide = gpu_draw.Tuning(tile=16, step=32, backward_step=32, **lanes)
    patch.setattr(gpu_draw, "TUNING", wide)
    patch.setattr(fused_gaussians_gpu, "LANES", 1024)
    patch.setattr(fused_gaussians_gpu, "ENTRIES", 256)
    patch.setattr(losses_gpu, "LANES", 8192)
    patch.setattr(adam_gpu, "LANES", 1 << 16)
    # Its search for integers that overflow takes a quarter of the time, and tells nobody unless Triton is being debugged.
    builder = interpreter.interpreter_builder
    patch.setattr(builder, "options", replace(builder.options, sanitize_overflow=False))
    numpy_type = cache(interpreter._get_np_dtype)

    def numpy_type_of(kind: Any) -> np.dtype:
        return np.dtype(np.uint64) if kind.scalar.is_ptr() else numpy_type(kind.scalar)

    patch.setattr(interpreter, "_get_np_dtype", numpy_type_of)
    # On a GPU the smaller of a number and NaN is the number.
    for name, function in (("create_minnumf", np.fmin), ("create_maxnumf", np.fmax)):
        chosen = partialmethod(interpreter.InterpreterBuilder.binary_op, op=function)
        patch.setattr(interpreter.InterpreterBuilder, name, chosen)
    # Triton's functions are replaced once, and not at each launch and call.
    replaced = interpreter._patch_lang(SimpleNamespace(__globals__={"tl": tl, "core": tl.core}))
    patch.setattr(interpreter, "_patch_lang", lambda _: interpreter._LangPatchScope())
    try:
        with np.errstate(all="ignore"):  # lanes that are masked out later may overflow
            yield
    finally:
        replaced.restore()


@contextmanager
def as_on_a_gpu(capacity: int | None = None) -> Iterator[dict[Any, int]]:
    """Drawings wait as on a GPU, the first of a kind and checked ones; gives what those fix, nothing at first, or
    `capacity` of every kind."""
    from avatar.splat import gpu_buffers

    fixed: dict[Any, int] = {} if capacity is None else _Always(capacity)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu_buffers, "_fixed", fixed)
        patch.setattr(gpu_buffers, "is_checked", lambda _: gpu_buffers._checked.get())
        yield fixed


class _Always(dict[Any, int]):
    def __init__(self, value: int) -> None:
        self._value = value

    def get(self, *_: Any) -> int:
        return self._value


@contextmanager
def the_cpus_way() -> Iterator[None]:
    """Tensors on the CPU take the compiled kernels in here, whether Triton interprets or not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("TRITON_INTERPRET", raising=False)
        yield


def error(found: Tensor, expected: Tensor) -> float:
    """The largest difference, relative to the largest value."""
    return float((found.detach().cpu() - expected.detach()).abs().max() / expected.detach().abs().max())


@dataclass
class Buffer:
    """Memory that was asked for, between two bands that nobody may write to."""

    whole: Tensor
    begin: int
    size: int


class Hostile(TorchDispatchMode):
    """Memory that torch.empty gives is full of poison, and lies between bands of it."""

    BAND = 64  # values on each side

    def __init__(self) -> None:
        super().__init__()
        self.buffers: list[Buffer] = []

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        made = function(*arguments, **(named or {}))
        if function.overloadpacket.__name__ in (
            "empty",
            "empty_like",
            "new_empty",
            "empty_strided",
            "new_empty_strided",
        ):
            return self.guarded(made)
        return made

    def guarded(self, like: Tensor) -> Tensor:
        """Poisoned memory of a tensor's size and type, contiguous."""
        whole = poisoned(torch.zeros(like.numel() + 2 * self.BAND, dtype=like.dtype))
        self.buffers.append(Buffer(whole, self.BAND, like.numel()))
        return whole[self.BAND : self.BAND + like.numel()].view(like.shape)

    def copy(self, tensor: Tensor) -> Tensor:
        """The same values, between bands."""
        return self.guarded(tensor).copy_(tensor)

    def assert_bands_are_whole(self) -> None:
        for buffer in self.buffers:
            poison = poisoned(torch.zeros(self.BAND, dtype=buffer.whole.dtype)).view(torch.uint8)
            end = buffer.begin + buffer.size
            for band in (buffer.whole[: buffer.begin], buffer.whole[end:]):
                assert torch.equal(band.view(torch.uint8), poison), f"{buffer.whole.dtype} [{buffer.size}] was overrun"


def poisoned(zeros: Tensor) -> Tensor:
    """NaN, or a number that is no index of anything."""
    if zeros.is_floating_point():
        return zeros.fill_(torch.nan)
    return zeros.fill_(torch.iinfo(zeros.dtype).max - 3)


@contextmanager
def hostile_interpreter(patch: pytest.MonkeyPatch, seed: int) -> Iterator[Hostile]:
    """Programs run in a random order, masked loads without a value give poison, and memory is as `Hostile` says."""
    from triton.runtime import interpreter

    builder, generator = interpreter.interpreter_builder, np.random.default_rng(seed)
    set_index, load = builder.set_grid_idx, interpreter.InterpreterBuilder.create_masked_load
    orders: dict[int, np.ndarray] = {}

    def set_random_index(x: int, y: int, z: int) -> None:
        if x == 0:
            orders[0] = generator.permutation(builder.grid_dim[0])
        set_index(int(orders[0][x]), y, z)

    def poisoning_load(self: Any, pointers: Any, mask: Any, other: Any, *rest: Any) -> Any:
        if other is None:
            kind = interpreter._get_np_dtype(pointers.get_element_ty())
            poison = np.nan if np.issubdtype(kind, np.floating) else np.iinfo(kind).max - 3
            other = interpreter.TensorHandle(np.full(pointers.data.shape, poison, kind), pointers.get_element_ty())
        return load(self, pointers, mask, other, *rest)

    patch.setattr(builder, "set_grid_idx", set_random_index)
    patch.setattr(interpreter.InterpreterBuilder, "create_masked_load", poisoning_load)
    with Hostile() as memory:
        yield memory
