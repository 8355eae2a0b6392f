"""Pieces of pickles, valid and not, to put together."""

from __future__ import annotations

import pickle
import struct

import numpy as np


def text(value: str) -> bytes:
    """BINUNICODE."""
    raw = value.encode()
    return b"X" + struct.pack("<I", len(raw)) + raw


def stack_global(module: str, name: str) -> bytes:
    return b"\x80\x04" + text(module) + text(name) + b"\x93"


def array_state(shape: bytes, dtype: str, raw: bytes) -> bytes:
    """An ndarray with this state, whatever it says."""
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01" + shape
        + b"cnumpy\ndtype\n" + text(dtype) + b"\x89\x88\x87R\x89" + raw + b"tb."
    )  # fmt: skip


def sparse(**state: object) -> bytes:
    attributes = pickle.dumps(state, 2)[2:-1]
    return b"\x80\x02cscipy.sparse.csc\ncsc_matrix\n)\x81" + attributes + b"b."


def array(value: np.ndarray) -> bytes:
    return pickle.dumps(value, 2)[2:-1]


def buffer(raw: bytes, *shape: int) -> bytes:
    """The float32 array of this shape that numpy makes of these bytes."""
    return (
        b"cnumpy.core.numeric\n_frombuffer\n(C" + bytes([len(raw)]) + raw + b"cnumpy\ndtype\n" + text("f4") + b"\x85R("
        + b"".join(b"J" + struct.pack("<i", n) for n in shape) + b"t" + text("C") + b"tR"
    )  # fmt: skip


def tensor(storage: bytes, size: bytes = b"K\x02\x85", stride: bytes = b"K\x01\x85", offset: bytes = b"K\x00") -> bytes:
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + storage + offset + size + stride + b"tR."


def nested_key(begin: bytes, end: bytes) -> tuple[bytes, str]:
    """A tuple in a tuple in a tuple ..., to be hashed: in C that overflows the stack."""
    return b"\x80\x04" + begin + b")" + b"\x85" * 100_000 + end + b".", "a tuple as a key"
