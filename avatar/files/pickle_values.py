"""What a pickle's instructions may build: inert stand-ins for numpy, scipy and chumpy objects, turned into arrays.

Nothing here imports or calls anything that a file names. A stand-in only keeps what the file said about an object until
`resolve` makes plain containers and numpy arrays of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

MAX_DEPTH = 64  # nesting of containers; official FLAME pickles have 3 to 5
_DTYPE = re.compile(r"[biufc](1|2|4|8|16)|\?|[SU]\d{1,4}")
TORCH_STORAGE_DTYPES = {
    "torch.DoubleStorage": "f8",
    "torch.FloatStorage": "f4",
    "torch.HalfStorage": "f2",
    "torch.LongStorage": "i8",
    "torch.IntStorage": "i4",
    "torch.ShortStorage": "i2",
    "torch.CharStorage": "i1",
    "torch.ByteStorage": "u1",
    "torch.BoolStorage": "?",
}
_SPARSE = re.compile(r"scipy\.sparse(\.(csc|csr|coo))?\.(csc|csr|coo)_(matrix|array)")


class Refused(Exception):
    """The file asks for something that is not data; the message is the reason, without the file's name."""


class Budget:
    """The bytes that one file may make us allocate: shared references let a small file ask for very much."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.left = limit

    def take(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise Refused(f"it would unpack to more than {self.limit / 2**20:.0f} MiB of arrays")


@dataclass(frozen=True)
class Global:
    """A name that the file refers to; never imported."""

    name: str  # module and attribute, module names of old versions normalised

    def is_sparse(self) -> bool:
        return _SPARSE.fullmatch(self.name) is not None

    def is_chumpy(self) -> bool:
        return self.name.startswith("chumpy.")


@dataclass
class DtypeValue:
    dtype: np.dtype


@dataclass
class ArrayValue:
    array: np.ndarray | None = None  # None until the file gives shape and data


@dataclass
class Instance:
    """An object of a chumpy or scipy class: its class name and its attributes."""

    cls: Global
    state: dict[Any, Any] = field(default_factory=dict)


def make_dtype(code: Any) -> DtypeValue:
    if not isinstance(code, str) or _DTYPE.fullmatch(code.lstrip("<>|=")) is None:
        shown = repr(code[:40]) if isinstance(code, str) else "that is not text"
        raise Refused(f"it holds an array of dtype {shown}, and only numbers and text are read")
    return DtypeValue(np.dtype(code))


def set_dtype_state(value: DtypeValue, state: Any) -> None:
    """`state` is numpy's (version, byte order, subarray, names, fields, size, alignment, flags)."""
    if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
        raise Refused("it holds a malformed dtype")
    if any(part is not None for part in state[2:5]):
        raise Refused("it holds a structured array, and only plain numbers are read")
    value.dtype = value.dtype.newbyteorder(state[1])


def make_array(shape: Any, dtype: Any, fortran: Any, raw: Any, budget: Budget) -> np.ndarray:
    """An array in this machine's byte order, writable, from the bytes in the file."""
    if isinstance(shape, int):
        shape = (shape,)
    if (
        not isinstance(shape, tuple)
        or len(shape) > 8
        or not all(isinstance(n, int) and 0 <= n < 2**40 for n in shape)
        or not isinstance(dtype, DtypeValue)
    ):
        raise Refused("it holds an array with a malformed shape or dtype")
    if isinstance(raw, str):  # bytes of a Python 2 pickle
        budget.take(len(raw))
        raw = raw.encode("latin1")
    if not isinstance(raw, (bytes, bytearray)):
        raise Refused("it holds an array of Python objects, and only numbers and text are read")
    needed = math.prod(shape) * dtype.dtype.itemsize
    if needed != len(raw):
        raise Refused(f"it holds an array of shape {shape} that needs {needed} bytes but has {len(raw)}")
    budget.take(needed)
    flat = np.frombuffer(raw, dtype.dtype)
    array = flat.reshape(shape, order="F" if fortran else "C")
    return array.astype(dtype.dtype.newbyteorder("="), order="C", copy=True)


def storage_array(identity: Any, read_member: Callable[[str], bytes], budget: Budget) -> np.ndarray:
    """A torch storage as a vector; `identity` is torch's ("storage", type, key, device, element count)."""
    if not (isinstance(identity, tuple) and len(identity) == 5 and identity[0] == "storage"):
        raise Refused("it refers to outside data that is not a torch storage")
    _, kind, key, _, count = identity
    code = TORCH_STORAGE_DTYPES.get(kind.name) if isinstance(kind, Global) else None
    if code is None or not (isinstance(key, str) and key.isascii() and key.isdigit()) or not isinstance(count, int):
        raise Refused("it refers to a torch storage of an unknown type")
    return make_array((count,), make_dtype(code), False, read_member(key), budget)


def tensor_array(storage: Any, offset: Any, size: Any, stride: Any, budget: Budget) -> np.ndarray:
    """The part of a storage that torch's (offset, size, stride), counted in elements, describes."""
    sizes_and_strides = (size, stride)
    if (
        not isinstance(storage, np.ndarray)
        or not isinstance(offset, int)
        or not all(isinstance(t, tuple) and all(isinstance(n, int) and n >= 0 for n in t) for t in sizes_and_strides)
        or len(size) != len(stride)
        or offset < 0
        or (math.prod(size) and offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True)) >= len(storage))
    ):
        raise Refused("it holds a torch tensor that reaches outside its storage")
    budget.take(math.prod(size) * storage.itemsize)
    strides = [s * storage.itemsize for s in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, strides).copy()


def resolve(value: Any, budget: Budget) -> Any:
    """Plain containers and arrays for everything that `value` holds; raises Refused for what has no such form."""
    return _resolve(value, budget, done={}, open_ids=set())


def _resolve(value: Any, budget: Budget, done: dict[int, Any], open_ids: set[int]) -> Any:
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, bytearray, np.generic, np.ndarray)):
        return value
    if isinstance(value, ArrayValue):
        if value.array is None:
            raise Refused("it names an array without giving its data")
        return value.array
    if id(value) in done:
        return done[id(value)]
    if id(value) in open_ids:
        raise Refused("it holds a container that contains itself")
    if len(open_ids) >= MAX_DEPTH:
        raise Refused(f"its containers are nested more than {MAX_DEPTH} deep")
    open_ids.add(id(value))
    result: Any
    if isinstance(value, dict):
        result = {key: _resolve(item, budget, done, open_ids) for key, item in value.items()}
    elif isinstance(value, list):
        result = [_resolve(item, budget, done, open_ids) for item in value]
    elif isinstance(value, tuple):
        result = tuple(_resolve(item, budget, done, open_ids) for item in value)
    elif isinstance(value, set):
        result = set(value)  # elements were checked to be text or numbers
    elif isinstance(value, Instance):
        state = _resolve(value.state, budget, done, open_ids)
        result = _sparse_array(value.cls, state, budget) if value.cls.is_sparse() else _chumpy_array(value.cls, state)
    elif isinstance(value, Global):
        raise Refused(f"it holds a reference to {value.name} where data is expected")
    else:
        raise Refused(f"it holds an object that is not data ({type(value).__name__})")
    open_ids.discard(id(value))
    done[id(value)] = result
    return result


def _chumpy_array(cls: Global, state: dict[Any, Any]) -> np.ndarray:
    """A `chumpy.ch.Ch` keeps its value in attribute `x`; other chumpy classes are formulas without a value."""
    if cls.name != "chumpy.ch.Ch" or not isinstance(state.get("x"), np.ndarray):
        raise Refused(f"it holds a {cls.name} whose value is not stored; save the model as numpy arrays (.npz)")
    return state["x"]


def _sparse_array(cls: Global, state: dict[Any, Any], budget: Budget) -> np.ndarray:
    """The dense array [rows, columns] of a scipy csc, csr or coo matrix; duplicate entries add up, as scipy has it."""
    kind = cls.name.rsplit(".", 1)[-1][:3]
    shape = state.get("_shape", state.get("shape"))
    if not (isinstance(shape, tuple) and len(shape) == 2 and all(isinstance(n, int) and n >= 0 for n in shape)):
        raise Refused(f"it holds a {cls.name} without a two-dimensional shape")
    data = _vector(cls, state, "data")
    if kind == "coo":
        coords = state.get("coords")
        rows, columns = (
            coords if isinstance(coords, tuple) and len(coords) == 2 else (state.get("row"), state.get("col"))
        )
        rows, columns = _vector(cls, {"row": rows}, "row"), _vector(cls, {"col": columns}, "col")
    else:
        minor, starts = _vector(cls, state, "indices"), _vector(cls, state, "indptr")
        major_size = shape[1] if kind == "csc" else shape[0]
        if len(starts) != major_size + 1 or starts[0] != 0 or (np.diff(starts) < 0).any() or starts[-1] > len(minor):
            raise Refused(f"it holds a {cls.name} whose indptr does not fit its shape {shape}")
        minor, data = minor[: starts[-1]], data[: starts[-1]]
        major = np.repeat(np.arange(major_size), np.diff(starts))
        rows, columns = (minor, major) if kind == "csc" else (major, minor)
    if not len(rows) == len(columns) == len(data):
        raise Refused(f"it holds a {cls.name} with {len(data)} values for {len(rows)} rows and {len(columns)} columns")
    for indices, size in ((rows, shape[0]), (columns, shape[1])):
        if len(indices) and (indices.min() < 0 or indices.max() >= size):
            raise Refused(f"it holds a {cls.name} with an index outside its shape {shape}")
    budget.take(math.prod(shape) * data.dtype.itemsize)
    dense = np.zeros(shape, data.dtype)
    np.add.at(dense, (rows, columns), data)
    return dense


def _vector(cls: Global, state: dict[Any, Any], name: str) -> np.ndarray:
    value = state.get(name)
    kinds = "biufc" if name == "data" else "iu"
    if not isinstance(value, np.ndarray) or value.ndim != 1 or value.dtype.kind not in kinds:
        raise Refused(f"it holds a {cls.name} whose {name} is not a vector of numbers")
    return value
