"""What pickles say of numpy, torch, scipy and chumpy objects, made into arrays without asking for more than is there.

Until then a stand-in keeps what the file said. Nothing here imports or calls anything that a file names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_DEPTH = 64  # nesting of containers; official FLAME pickles have 3 to 5
OBJECT_CLASS = re.compile(r"chumpy\..+|scipy\.sparse(\._?(csc|csr|coo))?\.(csc|csr|coo)_(matrix|array)")
_DTYPE = re.compile(r"[<>|=]?([biufc](1|2|4|8|16)|\?|[SU][0-9]{1,4})")
_MAX_DIMENSIONS = 8
_MAX_LENGTH = 2**40  # of one dimension; keeps products and offsets small numbers


class Refused(Exception):
    """The file asks for something that is not data; the message is the reason, without the file's name."""


class Budget:
    """The bytes that one file may make us allocate: shared references let a small file ask for very much."""

    def __init__(self, limit: int) -> None:
        self.limit = self.left = limit

    def take(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise Refused(f"it would unpack to more than {self.limit / 2**20:.0f} MiB of arrays")


@dataclass(frozen=True)
class Name:
    """What the file calls a class or function, old modules by their new names; never imported."""

    text: str


@dataclass(eq=False)
class PickledObject:
    """What a file says of an object: its class, and a np.dtype, np.ndarray or dict of attributes once it is given."""

    cls: str
    value: Any = None


def described(value: Any) -> str:
    match value:
        case Name(text):
            return text
        case PickledObject(cls):
            return f"a {cls}"
    return f"a {type(value).__name__}"


def make_dtype(code: Any) -> PickledObject:
    if not isinstance(code, str) or not _DTYPE.fullmatch(code):
        shown = repr(code[:40]) if isinstance(code, str) else "that is not text"
        raise Refused(f"it holds an array of dtype {shown}, and only numbers and text are read")
    return PickledObject("numpy.dtype", np.dtype(code))


def make_array(shape: Any, dtype: Any, fortran: Any, raw: Any, budget: Budget) -> np.ndarray:
    """An array in this machine's byte order, writable, from the bytes in the file."""
    shape = (shape,) if isinstance(shape, int) else shape
    if not _are_lengths(shape) or not isinstance(dtype, PickledObject) or not isinstance(dtype.value, np.dtype):
        raise Refused("it holds an array with a malformed shape or dtype")
    if not isinstance(raw, (bytes, bytearray, str)):
        raise Refused("it holds an array of Python objects, and only numbers and text are read")
    needed = math.prod(shape) * dtype.value.itemsize
    if needed != len(raw):
        raise Refused(f"it holds an array of shape {shape} that needs {needed} bytes but has {len(raw)}")
    budget.take(needed)
    raw = raw.encode("latin1") if isinstance(raw, str) else raw  # text is the bytes of a Python 2 pickle
    array = np.frombuffer(raw, dtype.value).reshape(shape, order="F" if fortran else "C")
    if not is_unicode(array):
        raise Refused("it holds text that is not Unicode")
    return array.astype(dtype.value.newbyteorder("="), order="C", copy=True)


def is_unicode(array: np.ndarray) -> bool:
    """Whether all text in an array can be made a str, and be written; true of arrays without text."""
    if array.dtype.kind != "U" or array.dtype.itemsize == 0:
        return True
    codes = np.ascontiguousarray(array).view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
    return bool(((codes <= 0x10FFFF) & ((codes < 0xD800) | (codes > 0xDFFF))).all())


def make_tensor(storage: Any, offset: Any, size: Any, stride: Any, budget: Budget) -> np.ndarray:
    """The part of a storage (a vector) that torch's (offset, size, stride), counted in elements, describes."""
    if (
        not isinstance(storage, np.ndarray)
        or storage.ndim != 1
        or not all(_are_lengths(lengths) for lengths in ((offset,), size, stride))
        or (math.prod(size) and offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True)) >= len(storage))
    ):
        raise Refused("it holds a torch tensor that reaches outside its storage")
    budget.take(math.prod(size) * storage.itemsize)
    strides = [s * storage.itemsize for s in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, strides).copy()


def plain(value: Any, budget: Budget, done: dict[int, Any], depth: int = 0) -> Any:
    """Plain containers and arrays for all that `value` holds; `done` keeps what is shared from being made twice."""
    if value is None or isinstance(value, (int, float, str, bytes, bytearray, np.generic, np.ndarray, set)):
        return value  # the elements of sets are flat
    if id(value) in done:
        return done[id(value)]
    if depth >= MAX_DEPTH:
        raise Refused(f"its containers are nested more than {MAX_DEPTH} deep, or one contains itself")

    def inner(item: Any) -> Any:
        return plain(item, budget, done, depth + 1)

    match value:
        case dict():
            result = {key: inner(item) for key, item in value.items()}
        case list() | tuple():
            result = type(value)(inner(item) for item in value)
        case PickledObject("numpy.ndarray", np.ndarray() as result):
            pass
        case PickledObject("numpy.ndarray"):
            raise Refused("it names an array without giving its data")
        case PickledObject(cls, None | dict() as state):
            result = _object_array(cls, {} if state is None else inner(state), budget)
        case _:
            raise Refused(f"it holds a reference to {described(value)} where data is expected")
    done[id(value)] = result
    return result


def _object_array(cls: str, state: Mapping[Any, Any], budget: Budget) -> np.ndarray:
    """The array that a chumpy or scipy object with these attributes stands for.

    A `chumpy.ch.Ch` keeps its value in attribute `x`; other chumpy classes are formulas without a value.
    """
    if cls.startswith("scipy."):
        return _dense(cls, state, budget)
    if cls != "chumpy.ch.Ch" or not isinstance(state.get("x"), np.ndarray):
        raise Refused(f"it holds a {cls} whose value is not stored; save the model as numpy arrays (.npz)")
    return state["x"]


def _dense(cls: str, state: Mapping[Any, Any], budget: Budget) -> np.ndarray:
    """The dense array [rows, columns] of a scipy csc, csr or coo matrix; duplicate entries add up, as scipy has it."""
    shape = state.get("_shape", state.get("shape"))
    if not _are_lengths(shape) or len(shape) != 2:
        raise Refused(f"it holds a {cls} without a two-dimensional shape")
    data = _vector(cls, state, "data", budget)
    budget.take(math.prod(shape) * data.itemsize)
    if "coo_" in cls:
        if isinstance(coords := state.get("coords"), tuple) and len(coords) == 2:
            state = dict(zip(("row", "col"), coords, strict=True))
        rows, columns = _vector(cls, state, "row", budget), _vector(cls, state, "col", budget)
    else:
        minor, starts = _vector(cls, state, "indices", budget), _vector(cls, state, "indptr", budget)
        major_size = shape[1] if "csc_" in cls else shape[0]
        if len(starts) != major_size + 1 or starts[0] != 0 or starts.max() > len(minor) or (np.diff(starts) < 0).any():
            raise Refused(f"it holds a {cls} whose indptr does not fit its shape {shape}")
        minor, data = minor[: starts[-1]], data[: starts[-1]]
        major = np.repeat(np.arange(major_size), np.diff(starts))
        rows, columns = (minor, major) if "csc_" in cls else (major, minor)
    if not len(rows) == len(columns) == len(data):
        raise Refused(f"it holds a {cls} with {len(data)} values for {len(rows)} rows and {len(columns)} columns")
    for indices, size in ((rows, shape[0]), (columns, shape[1])):
        if len(indices) and (indices.min() < 0 or indices.max() >= size):
            raise Refused(f"it holds a {cls} with an index outside its shape {shape}")
    dense = np.zeros(shape, data.dtype)
    np.add.at(dense, (rows, columns), data)
    return dense


def _vector(cls: str, state: Mapping[Any, Any], name: str, budget: Budget) -> np.ndarray:
    """The attribute as it is, or as int64 where it holds indices: differences of unsigned numbers are never negative."""
    value = state.get(name)
    is_data = name == "data"
    if not isinstance(value, np.ndarray) or value.ndim != 1 or value.dtype.kind not in ("biufc" if is_data else "iu"):
        raise Refused(f"it holds a {cls} whose {name} is not a vector of numbers")
    budget.take(8 * len(value))
    return value if is_data else value.astype(np.int64)


def _are_lengths(value: Any) -> bool:
    """Whether `value` is a tuple such as a shape."""
    return (
        isinstance(value, tuple)
        and len(value) <= _MAX_DIMENSIONS
        and all(isinstance(n, int) and 0 <= n < _MAX_LENGTH for n in value)
    )
