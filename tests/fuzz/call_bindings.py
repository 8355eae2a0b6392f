"""Calls of every compiled function with good arguments and with bad ones: it answers, or raises TypeError or ValueError.

Run by test_bindings.py in a process of its own, because what it looks for are crashes:
    python call_bindings.py EXAMPLES LAST
LAST is a file that always describes the call under way.
"""

from __future__ import annotations

import math
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor
from valid_calls import BINDINGS, Arguments, Shapes

from avatar import _core
from avatar.tensors import check_shapes

OPTIONAL = {"solved", "grad_latents", "grad_image", "grad_alpha", "gradient"}
EVIL = [None, "text", b"", object(), [], {}, 1.5, math.nan, -1, 0, 2**31, 2**70]
NUMBERS = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e308, 1e-320]
# Values that are refused for what the argument means; any number is taken for the others.
REFUSED = {
    "threads": [0, -1, 1025, 2**40],
    "simd": ["sse9", "avx"],
    "sh_degree": [-1, 4, 2**40],
    "region": [
        [0, 0, 0, 1],
        [0, 0, 1, 0],
        [-1, 0, 1, 1],
        [0, -1, 1, 1],
        [0, 0, 71, 1],
        [0, 0, 1, 71],
        [2**40, 0, 1, 1],
    ],
}


def grown(r: random.Random, array: Tensor) -> Tensor:
    """Zeros of another shape, or of the same; at most some megabytes, or none at all with a huge side."""
    shape = list(array.shape)
    kind = r.randrange(5)
    if kind == 0 and shape:
        shape.pop(r.randrange(len(shape)))
    elif kind == 1:
        shape.insert(r.randrange(len(shape) + 1), r.choice([0, 1, 2]))
    elif kind == 2:
        shape = [0] + [1] * (len(shape) - 1)
        shape[r.randrange(len(shape))] = r.choice([2**31, 2**40])
        r.shuffle(shape)
    elif shape:
        axis = r.randrange(len(shape))
        shape[axis] = max(0, r.choice([shape[axis] - 1, shape[axis] + 1, 2 * shape[axis], 0, 1, 1000]))
    return torch.zeros(shape, dtype=array.dtype) if math.prod(shape) < 1 << 22 else array


def other_array(r: random.Random, array: Tensor) -> Any:
    """What is wrong with the type, order, device or ownership of the array, or an equal one that is right."""
    dtypes = [torch.float64, torch.float16, torch.int64, torch.int32, torch.uint8, torch.bool, torch.complex64]
    kind = r.randrange(8)
    if kind == 0:
        return array.to(r.choice([dtype for dtype in dtypes if dtype != array.dtype]))
    if kind == 1:
        return torch.stack((array, array), -1)[..., 0]
    if kind == 2:
        return array.flip(0).T.contiguous().T if array.ndim == 2 else array.numpy()[::-1]
    if kind == 3:
        return array.to("meta")
    if kind == 4:
        return array.to_sparse()
    if kind == 5:
        return array.numpy().astype(array.numpy().dtype.newbyteorder(">"))
    if kind == 6:
        view = array.numpy().view()
        view.flags.writeable = False
        return view
    return array.numpy()


INTEGERS = {"faces": torch.int32, "face_id": torch.int32, "cells": torch.int32, "gaussians": torch.int32}
INTEGERS |= {"begins": torch.int64}
INDICES = {"faces", "cells", "gaussians", "begins"}


def right(call: Arguments, shapes: Shapes) -> bool:
    """Every array has the type, order and size for which reading and writing it stays within it."""
    plain = {}
    for name, shape in shapes.items():
        value = call[name]
        if value is None and name in OPTIONAL:
            continue
        if isinstance(value, np.ndarray):
            if not value.flags.c_contiguous or not value.dtype.isnative:
                return False
            value = torch.from_numpy(value.copy())
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.device.type != "cpu":
            return False
        if value.dtype != INTEGERS.get(name, torch.float32) or not value.is_contiguous():
            return False
        if max(value.shape, default=0) >= 2**31:
            return False
        plain[name] = (value, shape)
    try:
        check_shapes(**plain)
    except ValueError:
        return False
    return True


def in_range(name: str, call: Arguments) -> bool:
    """Whether all indices are. Only asked of right arrays."""

    def below(indices: str, rows: str) -> bool:
        found = np.asarray(call[indices]).ravel()
        return bool(((found >= 0) & (found < len(call[rows]))).all())

    if name == "rasterize_mesh":
        return below("faces", "screen")
    if name == "interpolate_forward":
        return below("cells", "grid")
    if name == "interpolate_backward":
        begins = np.asarray(call["begins"])
        rising = bool((np.diff(begins) >= 0).all()) and begins[0] >= 0 and begins[-1] == len(call["gaussians"])
        return below("gaussians", "grad") and rising
    return True


def other_indices(r: random.Random, array: Tensor) -> Tensor:
    """One of them, if there is any, is another number: next to the old one, or far beyond any array."""
    changed = array.clone().reshape(-1)
    if len(changed):
        place = r.randrange(len(changed))
        old = int(changed[place])
        changed[place] = r.choice([old - 1, old + 1, -1, 1000, 2**31 - 1, -(2**31)])
    return changed.reshape(array.shape)


def describe(value: Any) -> str:
    if not isinstance(value, Tensor | np.ndarray):
        return repr(value)[:100]
    return f"{type(value).__name__} {value.dtype} {tuple(value.shape)}"


@st.composite
def calls(draw: st.DrawFn) -> tuple[str, Arguments, bool | None]:
    """A compiled function, its arguments, and whether it has to answer (True), to raise (False), or may do either."""
    name = draw(st.sampled_from(sorted(BINDINGS)))
    r = random.Random(draw(st.integers(0, 2**32)))
    torch.manual_seed(r.randrange(2**32))
    call, shapes = BINDINGS[name](r)
    bad = draw(st.lists(st.sampled_from(list(call)), max_size=2, unique=True))
    good = not bad or None
    for argument in bad:
        kind = draw(st.sampled_from(["evil", "size", "kind", "other", "index"]))
        old = call[argument]
        if argument not in shapes:
            if argument in REFUSED and kind != "evil":
                call[argument], good = r.choice(REFUSED[argument]), False
            elif isinstance(old, list) and kind == "size":
                call[argument], good = r.choice([old[:-1], [*old, old[0]]]), False
            elif isinstance(old, list) and isinstance(old[0], float) and kind != "evil":
                call[argument] = [r.choice([*NUMBERS, value]) for value in old]
            elif isinstance(old, float) and kind != "evil":
                call[argument] = r.choice(NUMBERS)
            else:
                call[argument] = r.choice(EVIL)
        elif kind == "evil" or not isinstance(old, Tensor):
            call[argument] = r.choice(EVIL)
        elif kind == "size":
            call[argument] = grown(r, old)
        elif kind == "index" and argument in INDICES:
            call[argument] = other_indices(r, old)
        elif kind == "kind":
            call[argument] = other_array(r, old)
        else:
            call[argument] = call[r.choice(list(call))]
    if not (right(call, shapes) and in_range(name, call)):
        good = False
    return name, call, good


def main(examples: int, last: Path) -> None:
    counts = {True: 0, False: 0}

    @settings(
        max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(calls())
    def answer_or_raise(drawn: tuple[str, Arguments, bool | None]) -> None:
        name, call, good = drawn
        words = ", ".join(f"{argument}={describe(value)}" for argument, value in call.items())
        last.write_text(f"{name}({words})")
        try:
            getattr(_core, name)(**call)
            answered = True
        except (TypeError, ValueError):
            answered = False
        counts[answered] += 1
        assert good is None or answered == good, f"{'answered' if answered else 'refused'} {name}({words})"

    answer_or_raise()
    print(f"{counts[True]} answered, {counts[False]} refused")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
