"""The pickle virtual machine, reduced to the instructions that make data."""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable
from typing import Any

import numpy as np

from avatar.files.pickle_values import (
    TORCH_STORAGE_DTYPES,
    ArrayValue,
    Budget,
    DtypeValue,
    Global,
    Instance,
    Refused,
    make_array,
    make_dtype,
    set_dtype_state,
    tensor_array,
)

MAX_INSTRUCTIONS = 3_000_000  # FLAME's pickles have thousands; a list of 10,000 faces has 40,000
PersistentLoad = Callable[[Any, Budget], np.ndarray]
_OPCODES = {opcode.code: opcode for opcode in pickletools.opcodes}
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
    "builtins.bytes",
    "builtins.bytearray",
    "collections.OrderedDict",
    "torch._utils._rebuild_tensor_v2",
    *TORCH_STORAGE_DTYPES,
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
    [
        "INT",
        "BININT",
        "BININT1",
        "BININT2",
        "LONG",
        "LONG1",
        "LONG4",
        "FLOAT",
        "BINFLOAT",
        "STRING",
        "BINSTRING",
        "SHORT_BINSTRING",
        "UNICODE",
        "BINUNICODE",
        "SHORT_BINUNICODE",
        "BINUNICODE8",
        "BINBYTES",
        "SHORT_BINBYTES",
        "BINBYTES8",
        "BYTEARRAY8",
    ]
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


class PickleMachine:
    """The pickle virtual machine, without the instructions that could reach code."""

    def __init__(self, stream: io.BytesIO, budget: Budget, persistent: PersistentLoad | None) -> None:
        self.stream = stream
        self.budget = budget
        self.persistent = persistent
        self.stack: list[Any] = []
        self.outer_stacks: list[list[Any]] = []  # one per MARK
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        """The value of the next pickle in the stream, for `pickle_values.resolve`.

        Raises Refused for what is not data, and a variety of exceptions for what is not a pickle.
        """
        for _ in range(MAX_INSTRUCTIONS):
            code = self.stream.read(1)
            if not code:
                raise ValueError("it ends before the pickle does")
            opcode = _OPCODES.get(code.decode("latin1"))
            if opcode is None:
                raise ValueError(f"unknown instruction {code!r} at byte {self.stream.tell() - 1}")
            if opcode.name == "STOP":
                (value,) = self.stack
                return value
            if opcode.name == "STRING":  # pickletools takes ASCII only; Python 2 wrote arrays this way
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
        if name == "builtins.bytes" and not arguments:  # protocols below 3 write empty bytes so
            return b""
        if name == "builtins.bytearray" and len(arguments) == 1:
            raw = _typed(arguments[0], bytes)
            self.budget.take(len(raw))
            return bytearray(raw)
        if name == "collections.OrderedDict" and len(arguments) <= 1:
            pairs = [_typed(pair, list) for pair in _typed(arguments[0] if arguments else [], list)]
            return {_checked_key(key): value for key, value in pairs}
        if name == "torch._utils._rebuild_tensor_v2" and len(arguments) >= 4:
            return tensor_array(*arguments[:4], self.budget)
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
