"""Python's own pickle machine, kept to data: names stay names, and what would call or import something does neither."""

from __future__ import annotations

import io
import pickle
import pickletools
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from avatar.files.pickled_data import (
    OBJECT_CLASS,
    Budget,
    Name,
    PickledObject,
    Refused,
    described,
    make_array,
    make_dtype,
    make_tensor,
)

MAX_INSTRUCTIONS = 3_000_000  # FLAME's pickles have thousands; a list of 10,000 faces has 40,000
_ENTRY_BYTES = 128  # of a set or dictionary, at most, beside key and value
_INSTRUCTIONS = """
    PROTO FRAME MARK POP POP_MARK DUP PUT BINPUT LONG_BINPUT GET BINGET LONG_BINGET MEMOIZE
    NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING
    UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8
    EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST LIST APPEND APPENDS EMPTY_DICT DICT SETITEM SETITEMS
    EMPTY_SET ADDITEMS GLOBAL STACK_GLOBAL REDUCE NEWOBJ BUILD BINPERSID
"""
_STORAGES = {"torch.DoubleStorage": "f8", "torch.FloatStorage": "f4", "torch.HalfStorage": "f2"}
_STORAGES |= {"torch.LongStorage": "i8", "torch.IntStorage": "i4", "torch.ShortStorage": "i2"}
_STORAGES |= {"torch.CharStorage": "i1", "torch.ByteStorage": "u1", "torch.BoolStorage": "?"}
_NAMES = """
    numpy.core.multiarray._reconstruct numpy.core.multiarray.scalar numpy.core.numeric._frombuffer numpy.ndarray
    numpy.dtype _codecs.encode copyreg._reconstructor builtins.object builtins.set builtins.bytes builtins.bytearray
    collections.OrderedDict torch._utils._rebuild_tensor_v2
"""
_RENAMED = {"__builtin__": "builtins", "copy_reg": "copyreg"}
_RENAMED |= {f"numpy._core.{part}": f"numpy.core.{part}" for part in ("multiarray", "numeric")}


class DataUnpickler(pickle._Unpickler):
    """Reads the data of the next pickle in a stream, for `plain` to finish.

    Raises Refused for what is not data, and what reading nonsense raises for what is not a pickle. `pickle.Unpickler`,
    the same machine in C, will not do: it allocates for whatever memo slot a file names, overflows the stack when a nested
    tuple is a key, and gives out what extension codes stand for without asking `find_class`.
    """

    pop_mark: Callable[[], list[Any]]

    def __init__(self, stream: io.BytesIO, budget: Budget, read_storage: Callable[[str], bytes] | None) -> None:
        super().__init__(stream, encoding="latin1")
        self.read, self.readline = stream.read, stream.readline
        self.budget = budget
        self.read_storage = read_storage
        self.stack: list[Any] = []
        self.append = self.stack.append
        self.metastack: list[list[Any]] = []  # one stack per mark

    def load(self) -> Any:
        for _ in range(MAX_INSTRUCTIONS):
            code = self.read(1)
            if code == pickle.STOP:
                (value,) = self.stack
                if self.metastack:
                    raise ValueError("it ends after a mark")
                return value
            if code not in _STEPS:
                raise _no_step(code)
            _STEPS[code](self)
        raise Refused(f"it has more than {MAX_INSTRUCTIONS} instructions")

    def load_frame(self) -> None:
        self.read(8)  # all is in memory, so there is nothing to be read ahead

    def find_class(self, module: str, name: str) -> Name:
        known = f"{_RENAMED.get(module, module)}.{name}"
        if known in _NAMES.split() or known in _STORAGES or OBJECT_CLASS.fullmatch(known):
            return Name(known)
        raise Refused(
            f"it refers to {module}.{name}, which is code and not data; only use files whose origin you trust"
        )

    def persistent_load(self, pid: Any) -> np.ndarray:
        """A torch storage as a vector; `pid` is torch's ("storage", type, key, device, element count)."""
        if self.read_storage is None:
            raise Refused("it has the instruction BINPERSID, which data does not need")
        match pid:
            case ("storage", Name(kind), str(key), _, count) if kind in _STORAGES and re.fullmatch("[0-9]+", key):
                return make_array((count,), make_dtype(_STORAGES[kind]), False, self.read_storage(key), self.budget)
            case ("storage", *_):
                raise Refused("it refers to a torch storage of an unknown type")
        raise Refused("it refers to outside data that is not a torch storage")

    def load_reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        self.append(self._made(described(function), arguments))

    def _made(self, name: str, arguments: Any) -> Any:
        """What a call of `name` would give, for the few that stand for data."""
        match name, arguments:
            case "numpy.core.multiarray._reconstruct", (Name("numpy.ndarray"), _, _):
                return PickledObject("numpy.ndarray")
            case "numpy.core.multiarray.scalar", (dtype, raw):
                return make_array((), dtype, False, raw, self.budget)[()]
            case "numpy.core.numeric._frombuffer", (raw, dtype, shape, order):
                return make_array(shape, dtype, order == "F", raw, self.budget)
            case "numpy.core.numeric._frombuffer", (raw, dtype, shape, "K", tuple(axes)):
                return make_array(shape, dtype, False, raw, self.budget).transpose(axes)
            case "numpy.dtype", (code, *_):
                return make_dtype(code)
            case "_codecs.encode", (str(text), "latin1" | "latin-1"):
                self.budget.take(len(text))
                return text.encode("latin1")
            case "builtins.bytes", ():  # protocols below 3 write empty bytes so
                return b""
            case "builtins.bytearray", (bytes(raw),):
                self.budget.take(len(raw))
                return bytearray(raw)
            case "builtins.set" | "collections.OrderedDict", () | (list(),):
                entries = arguments[0] if arguments else []
                self.budget.take(_ENTRY_BYTES * len(entries))
                return {_key(e) for e in entries} if name == "builtins.set" else {_key(k): v for k, v in entries}
            case "torch._utils._rebuild_tensor_v2", (storage, offset, size, stride, *_):
                return make_tensor(storage, offset, size, stride, self.budget)
            case "copyreg._reconstructor", (cls, Name("builtins.object"), None):
                return _new_object(cls, ())
            case _, () if OBJECT_CLASS.fullmatch(name):
                return PickledObject(name)
        raise Refused(f"it calls {name} in a way that data does not need")

    def load_newobj(self) -> None:
        arguments, cls = self.stack.pop(), self.stack.pop()
        self.append(_new_object(cls, arguments))

    def load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        match target, state:
            case PickledObject("numpy.ndarray", None), (_, shape, dtype, fortran, raw):
                target.value = make_array(shape, dtype, fortran, raw, self.budget)
            case PickledObject("numpy.dtype", dtype), (_, "<" | ">" | "|" | "=" as order, None, None, None, *_):
                target.value = dtype.newbyteorder(order)
            case PickledObject("numpy.dtype"), _:
                raise Refused("it holds a structured array or a malformed dtype, and only plain numbers are read")
            case PickledObject(value=None), dict():
                target.value = state
            case _:
                raise Refused(f"it sets the state of {described(target)}, which data does not need")

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._fill(items)

    def load_setitem(self) -> None:
        self._fill([self.stack.pop(-2), self.stack.pop()])

    def load_setitems(self) -> None:
        self._fill(self.pop_mark())

    def _fill(self, items: list[Any]) -> None:
        dict.update(self.stack[-1], ((_key(k), value) for k, value in zip(items[::2], items[1::2], strict=True)))

    def load_additems(self) -> None:
        items = self.pop_mark()
        set.update(self.stack[-1], map(_key, items))

    def load_bytearray8(self) -> None:
        (length,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(length)))  # Python's makes `length` zeros first


_STEPS = {
    opcode.code.encode("latin1"): getattr(DataUnpickler, pickle._Unpickler.dispatch[ord(opcode.code)].__name__)
    for opcode in pickletools.opcodes
    if opcode.name in _INSTRUCTIONS.split()
}


def _no_step(code: bytes) -> Exception:
    """Why there is no step for this instruction."""
    for opcode in pickletools.opcodes:
        if opcode.code.encode("latin1") == code:
            return Refused(f"it has the instruction {opcode.name}, which data does not need")
    return ValueError(f"unknown instruction {code!r}") if code else EOFError()


def _new_object(cls: Any, arguments: Any) -> PickledObject:
    match cls, arguments:
        case Name(text), () if OBJECT_CLASS.fullmatch(text):
            return PickledObject(text)
    raise Refused(f"it makes an object of {described(cls)}")


def _key(key: Any) -> Any:
    """Only flat keys: hashing a deeply nested tuple would overflow the stack, and large integers can share one hash."""
    if key is None or isinstance(key, (str, float, bytes)) or (isinstance(key, int) and abs(key) < 2**60):
        return key
    what = "an integer of more than 60 bits" if isinstance(key, int) else described(key)
    raise Refused(f"it uses {what} as a key, and only text and numbers are read")
