"""Reading of other programs' pickles (.pkl, .frame, .npz) without ever running what they contain.

A pickle is a program. This module interprets its instructions itself and knows only those that make plain containers,
numpy arrays, scipy sparse matrices (dense on return), `chumpy.ch.Ch` arrays and torch tensors (numpy on return). Names in
the file are compared with a list and never imported, so there is nothing that a file could call.
"""

from __future__ import annotations

import io
import math
import pickletools
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data_prep.pickle_values import (
    ArrayValue,
    Budget,
    DtypeValue,
    Global,
    Instance,
    Refused,
    make_array,
    make_dtype,
    resolve,
    set_dtype_state,
)
from avatar.errors import UserError

MAX_FILE_BYTES = 2**30  # FLAME's largest pickle has 53 MB
MAX_INSTRUCTIONS = 3_000_000  # FLAME's have thousands; a list of 10,000 faces has 40,000
MIN_BUDGET_BYTES = 2**26
_LEGACY_TORCH_MAGIC = 0x1950A86A20F9469CFC6C  # first pickle of a file that torch.save wrote before 1.6
_TORCH_STORAGE_DTYPES = {
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
_NAMES = {
    "numpy.core.multiarray._reconstruct",
    "numpy.core.multiarray.scalar",
    "numpy.core.numeric._frombuffer",
    "numpy.ndarray",
    "numpy.dtype",
    "_codecs.encode",
    "copyreg._reconstructor",
    "builtins.object",
    "builtins.set",
    "builtins.bytearray",
    "collections.OrderedDict",
    "torch._utils._rebuild_tensor_v2",
    *_TORCH_STORAGE_DTYPES,
}
_OLD_MODULES = {
    "__builtin__": "builtins",
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
    "scipy.sparse._csc": "scipy.sparse.csc",
    "scipy.sparse._csr": "scipy.sparse.csr",
    "scipy.sparse._coo": "scipy.sparse.coo",
}
# Instructions that push their own argument.
_LITERALS = frozenset(
    "INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE "
    "SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8".split()
)
_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "EMPTY_SET": set,
}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PersistentLoad = Callable[[Any, Budget], np.ndarray]


def load_pickle(source: Path | str | bytes, name: str | None = None) -> Any:
    """The data in a pickle file (any protocol; Python 2 text is read as latin-1).

    `source` is a path, or the bytes themselves with `name` for messages. Returns dicts, lists, tuples, numbers, text and
    numpy arrays. Raises UserError, naming the file, when it is damaged or holds anything else.
    """
    data, name = _read(source, name)
    return _unpickle_all(data, name, count=1, persistent=None)[0]


def load_torch_pickle(source: Path | str | bytes, name: str | None = None) -> Any:
    """The data in a file written by `torch.save`, tensors as numpy arrays. Raises UserError as `load_pickle` does."""
    data, name = _read(source, name)
    if not data.startswith(b"PK"):
        return _load_legacy_torch(data, name)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            pickles = [member for member in sizes if member == "data.pkl" or member.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise UserError(
                    f"{name} is a zip file but not one that torch.save wrote: it has {len(pickles)} data.pkl"
                )
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()) or sum(
                sizes.values()
            ) > len(data):
                raise UserError(f"{name} holds compressed members, which torch.save never writes; write it again")
            root = pickles[0][: -len("data.pkl")]

            def load_storage(identity: Any, budget: Budget) -> np.ndarray:
                return _torch_storage(identity, lambda key: archive.read(f"{root}data/{key}"), budget)

            return _unpickle_all(archive.read(pickles[0]), name, count=1, persistent=load_storage)[0]
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError, struct.error) as error:
        raise UserError(f"{name} is damaged or cut short ({error}); write or copy it again") from error


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; pickled objects inside are refused. Raises UserError naming the file."""
    try:
        with zipfile.ZipFile(path) as members:
            if sum(info.file_size for info in members.infolist()) > MAX_FILE_BYTES:
                raise UserError(f"{path} would unpack to more than {MAX_FILE_BYTES} bytes; such files are not read")
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist") from error
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, MemoryError) as error:
        if "allow_pickle" in str(error) or "pickled" in str(error):
            raise UserError(f"{path} holds pickled Python objects; save it again with plain numeric arrays") from error
        raise UserError(f"{path} is damaged or not a .npz file ({error})") from error


def _read(source: Path | str | bytes, name: str | None) -> tuple[bytes, str]:
    if isinstance(source, bytes):
        data, name = source, name or "the data"
    else:
        path = Path(source)
        name = name or str(path)
        try:
            size = path.stat().st_size
            if size > MAX_FILE_BYTES:
                raise UserError(f"{name} has {size} bytes; files of more than {MAX_FILE_BYTES} bytes are not read")
            data = path.read_bytes()
        except OSError as error:
            raise UserError(f"{name} cannot be read: {error.strerror}") from error
    if not data:
        raise UserError(f"{name} is empty; write or copy it again")
    return data, name


def _load_legacy_torch(data: bytes, name: str) -> Any:
    """torch.save before 1.6 wrote magic number, version, system information and the object, one pickle each."""
    stream_start = _unpickle_all(data, name, count=1, persistent=None)[0]
    if stream_start != _LEGACY_TORCH_MAGIC:
        raise UserError(f"{name} was not written by torch.save (neither its zip format nor the older one)")
    return _unpickle_all(data, name, count=4, persistent=None)[3]


def _unpickle_all(data: bytes, name: str, count: int, persistent: _PersistentLoad | None) -> list[Any]:
    stream = io.BytesIO(data)
    budget = Budget(max(4 * len(data), MIN_BUDGET_BYTES))
    try:
        return [resolve(_Machine(stream, budget, persistent).run(), budget) for _ in range(count)]
    except Refused as error:
        raise UserError(f"{name} was not read: {error}") from error
    except (
        ValueError,
        IndexError,
        KeyError,
        TypeError,
        OverflowError,
        MemoryError,
        RecursionError,
        struct.error,
    ) as error:
        raise UserError(f"{name} is damaged, cut short or not a pickle ({error})") from error


class _Machine:
    """The pickle virtual machine, without the instructions that could reach code."""

    def __init__(self, stream: io.BytesIO, budget: Budget, persistent: _PersistentLoad | None) -> None:
        self.stream = stream
        self.budget = budget
        self.persistent = persistent
        self.stack: list[Any] = []
        self.outer_stacks: list[list[Any]] = []  # one per MARK
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        for _ in range(MAX_INSTRUCTIONS):
            code = self.stream.read(1)
            if not code:
                raise ValueError("it ends before the pickle does")
            opcode = pickletools.code2op.get(code.decode("latin1"))
            if opcode is None:
                raise ValueError(f"unknown instruction {code!r} at byte {self.stream.tell() - 1}")
            if opcode.name == "STOP":
                (value,) = self.stack
                return value
            if opcode.name == "STRING":  # pickletools reads ASCII only; Python 2 wrote arrays this way
                argument = _read_python2_string(self.stream)
            else:
                argument = opcode.arg.reader(self.stream) if opcode.arg is not None else None
            self.execute(opcode.name, argument)
        raise Refused(f"it has more than {MAX_INSTRUCTIONS} instructions")

    def execute(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in _LITERALS:
            stack.append(argument)
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            self.memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(self.memo[argument])
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in _TUPLES:
            size = _TUPLES[name]
            if len(stack) < size:
                raise IndexError("the stack is too short for a tuple")
            stack[-size:] = [tuple(stack[-size:])]
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name == "MARK":
            self.outer_stacks.append(stack)
            self.stack = []
        elif name == "TUPLE":
            items = self.pop_mark()
            self.stack.append(tuple(items))
        elif name == "LIST":
            items = self.pop_mark()
            self.stack.append(items)
        elif name == "DICT":
            items = self.pop_mark()
            self.stack.append({})
            self.set_items(items)
        elif name in ("APPEND", "APPENDS"):
            items = self.pop_mark() if name == "APPENDS" else [stack.pop()]
            _typed(self.stack[-1], list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = self.pop_mark() if name == "SETITEMS" else [stack.pop(-2), stack.pop()]
            self.set_items(items)
        elif name == "ADDITEMS":
            items = self.pop_mark()
            _typed(self.stack[-1], set).update(_checked_key(item) for item in items)
        elif name == "GLOBAL":
            stack.append(_known_global(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(_known_global(_typed(module, str), _typed(attribute, str)))
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            stack.append(self.construct(function, _typed(arguments, tuple)))
        elif name == "NEWOBJ":
            arguments, cls = stack.pop(), stack.pop()
            stack.append(_new_instance(cls, _typed(arguments, tuple)))
        elif name == "BUILD":
            state = stack.pop()
            self.set_state(stack[-1], state)
        elif name == "BINPERSID" and self.persistent is not None:
            stack.append(self.persistent(stack.pop(), self.budget))
        elif name == "POP":
            stack.pop()
        elif name == "POP_MARK":
            self.pop_mark()
        elif name == "DUP":
            stack.append(stack[-1])
        elif name not in ("PROTO", "FRAME"):
            raise Refused(f"it has the instruction {name}, which data does not need")

    def pop_mark(self) -> list[Any]:
        items, self.stack = self.stack, self.outer_stacks.pop()
        return items

    def set_items(self, items: list[Any]) -> None:
        target = _typed(self.stack[-1], dict)
        for key, value in zip(items[0::2], items[1::2], strict=True):
            target[_checked_key(key)] = value

    def construct(self, function: Any, arguments: tuple[Any, ...]) -> Any:
        """What calling `function` would give, for the few names that stand for data."""
        name = function.name if isinstance(function, Global) else type(function).__name__
        if name == "numpy.core.multiarray._reconstruct" and arguments[:1] == (Global("numpy.ndarray"),):
            return ArrayValue()
        if name == "numpy.core.multiarray.scalar" and len(arguments) == 2:
            return make_array((), *(arguments[0], False, arguments[1]), self.budget)[()]
        if name == "numpy.core.numeric._frombuffer" and len(arguments) == 4:
            raw, dtype, shape, order = arguments
            return make_array(shape, dtype, order == "F", raw, self.budget)
        if name == "numpy.dtype" and 1 <= len(arguments) <= 3:
            return make_dtype(arguments[0])
        if name == "_codecs.encode" and len(arguments) == 2 and arguments[1] in ("latin1", "latin-1"):
            text = _typed(arguments[0], str)
            self.budget.take(len(text))
            return text.encode("latin1")
        if name == "copyreg._reconstructor" and arguments[1:] == (Global("builtins.object"), None):
            return _new_instance(arguments[0], ())
        if name == "builtins.set" and len(arguments) <= 1:
            return {_checked_key(item) for item in _typed(arguments[0] if arguments else [], list)}
        if name == "builtins.bytearray" and len(arguments) == 1:
            raw = _typed(arguments[0], bytes)
            self.budget.take(len(raw))
            return bytearray(raw)
        if name == "collections.OrderedDict" and len(arguments) <= 1:
            pairs = [_typed(pair, list) for pair in _typed(arguments[0] if arguments else [], list)]
            return {_checked_key(key): value for key, value in pairs}
        if name == "torch._utils._rebuild_tensor_v2" and len(arguments) >= 4:
            return _torch_tensor(*arguments[:4], self.budget)
        if isinstance(function, Global) and function.is_sparse() and not arguments:
            return _new_instance(function, ())
        raise Refused(f"it calls {name} in a way that data does not need")

    def set_state(self, target: Any, state: Any) -> None:
        if isinstance(target, ArrayValue) and target.array is None and isinstance(state, tuple) and len(state) == 5:
            target.array = make_array(*state[1:], self.budget)
        elif isinstance(target, DtypeValue):
            set_dtype_state(target, state)
        elif isinstance(target, Instance) and isinstance(state, dict):
            target.state.update(state)
        else:
            raise Refused(f"it sets the state of a {type(target).__name__}, which data does not need")


def _known_global(module: str, attribute: str) -> Global:
    known = Global(f"{_OLD_MODULES.get(module, module)}.{attribute}")
    if known.name in _NAMES or known.is_sparse() or known.is_chumpy():
        return known
    raise Refused(
        f"it refers to {module}.{attribute}, which is code and not data; only use files whose origin you trust"
    )


def _new_instance(cls: Any, arguments: tuple[Any, ...]) -> Instance:
    if isinstance(cls, Global) and (cls.is_sparse() or cls.is_chumpy()) and not arguments:
        return Instance(cls)
    raise Refused(f"it makes an object of {cls.name if isinstance(cls, Global) else 'something unnamed'}")


def _torch_storage(identity: Any, read_member: Callable[[str], bytes], budget: Budget) -> np.ndarray:
    """A torch storage as a vector; `identity` is torch's ("storage", type, key, device, element count)."""
    if not (isinstance(identity, tuple) and len(identity) == 5 and identity[0] == "storage"):
        raise Refused("it refers to outside data that is not a torch storage")
    _, kind, key, _, count = identity
    code = _TORCH_STORAGE_DTYPES.get(kind.name) if isinstance(kind, Global) else None
    if code is None or not (isinstance(key, str) and key.isascii() and key.isdigit()) or not isinstance(count, int):
        raise Refused("it refers to a torch storage of an unknown type")
    return make_array((count,), make_dtype(code), False, read_member(key), budget)


def _torch_tensor(storage: Any, offset: Any, size: Any, stride: Any, budget: Budget) -> np.ndarray:
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


def _read_python2_string(stream: io.BytesIO) -> str:
    line = stream.readline()
    if len(line) < 3 or line[-1:] != b"\n" or line[:1] not in (b"'", b'"') or line[-2:-1] != line[:1]:
        raise ValueError("a text without its closing quote")
    return line[1:-2].decode("unicode_escape")  # bytes above 127 as latin-1


def _checked_key(key: Any) -> Any:
    """Only flat keys: hashing a deeply nested tuple would overflow the stack."""
    if key is None or isinstance(key, (str, int, float, bytes)):
        return key
    raise Refused(f"it uses a {type(key).__name__} as a key, and only text and numbers are read")


def _typed(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise Refused(f"it has a {type(value).__name__} where a {kind.__name__} must be")
    return value
