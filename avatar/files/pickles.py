"""Reading of other programs' pickles (.pkl, .frame) and arrays (.npz, .npy) without running what they contain.

A pickle is a program. `DataUnpickler` follows it only as far as it makes data: nothing is imported or called. Objects of
numpy, scipy, chumpy and torch come back as numpy arrays, sparse matrices as dense ones.
"""

from __future__ import annotations

import io
import lzma
import math
import pickle
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.data_unpickler import DataUnpickler
from avatar.files.pickled_data import Budget, Refused, is_unicode, plain
from avatar.files.read import open_file, read_bytes

MAX_FILE_BYTES = 2**30  # FLAME's largest pickle has 53 MB
MIN_BUDGET_BYTES = 2**26
_LEGACY_TORCH_MAGIC = 0x1950A86A20F9469CFC6C  # first pickle of a file that torch.save wrote before 1.6
_MALFORMED = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, RecursionError)
_MALFORMED += (EOFError, struct.error, pickle.UnpicklingError)  # what reading nonsense as a pickle runs into
_BAD_ZIP = (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError)  # the same for an archive


class UnsafeFileError(UserError):
    """The file asks for something that is not data, so it was not merely damaged."""


def load_pickle(source: Path | str | bytes, name: str | None = None) -> Any:
    """The data in a pickle file (any protocol; Python 2 text is read as latin-1).

    `source` is a path, or the bytes themselves with `name` for messages. Returns dicts, lists, tuples, numbers, text
    and numpy arrays. Raises UserError, naming the file, when it is damaged, and UnsafeFileError (a
    UserError) when it holds anything else.
    """
    data, name = _read(source, name)
    return _unpickle(io.BytesIO(data), name, _budget(data))


def load_torch_pickle(source: Path | str | bytes, name: str | None = None) -> Any:
    """The data in a file written by `torch.save`, tensors as numpy arrays. Raises UserError as `load_pickle` does."""
    data, name = _read(source, name)
    if not data.startswith(b"PK"):
        return _load_legacy_torch(data, name)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            pickles = [member for member in archive.namelist() if member == "data.pkl" or member.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise UserError(f"{name} is a zip file that torch.save did not write: it has {len(pickles)} data.pkl")
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise UserError(f"{name} holds compressed members, which torch.save never writes; write it again")
            root = pickles[0].removesuffix("data.pkl")
            stream = io.BytesIO(archive.read(pickles[0]))
            return _unpickle(stream, name, _budget(data), lambda key: archive.read(f"{root}data/{key}"))
    except (*_BAD_ZIP, *_MALFORMED) as error:
        raise UserError(f"{name} is damaged or cut short ({_short(error)}); write or copy it again") from error


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; pickled objects inside are refused. Raises UserError naming the file."""
    try:
        with open_file(path, MAX_FILE_BYTES) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if sum(info.file_size for info in members) > MAX_FILE_BYTES:
                raise UserError(f"{path} would unpack to more than {MAX_FILE_BYTES} bytes; such files are not read")
            return {info.filename.removesuffix(".npy"): _parse_npy(archive.read(info), path) for info in members}
    except (*_MALFORMED, *_BAD_ZIP, zlib.error, lzma.LZMAError) as error:
        raise UserError(f"{path} is damaged or not a .npz file ({_short(error)})") from error


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a .npz file, whole or not at all. Raises UserError when the disk refuses."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())


def load_npy(path: Path) -> np.ndarray:
    """The array of a .npy file; pickled objects are refused. Raises UserError naming the file."""
    data, _ = _read(path, None)
    return _parse_npy(data, path)


def _parse_npy(data: bytes, path: Path) -> np.ndarray:
    """numpy allocates what the header says before it looks how much there is, so the header is compared first."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, is_fortran, dtype = read_header(stream)
        if dtype.hasobject:
            raise UserError(f"{path} holds pickled Python objects; save it again with plain numeric arrays")
        needed, given = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
        if min(shape, default=0) < 0 or needed != given:
            raise UserError(f"{path} is damaged: an array of shape {list(shape)} needs {needed} bytes, it has {given}")
        flat = np.frombuffer(data, dtype, offset=stream.tell())
        if not is_unicode(flat):
            raise UserError(f"{path} is damaged: it holds text that is not Unicode")
        return flat.reshape(shape, order="F" if is_fortran else "C").copy()
    except (*_MALFORMED, SyntaxError, tokenize.TokenError) as error:
        raise UserError(f"{path} is damaged or holds no numpy arrays ({_short(error)})") from error


def _load_legacy_torch(data: bytes, name: str) -> Any:
    """torch.save before 1.6 wrote magic number, version, system information and the object, one pickle each."""
    stream, budget = io.BytesIO(data), _budget(data)
    if _unpickle(stream, name, budget) != _LEGACY_TORCH_MAGIC:
        raise UserError(f"{name} was not written by torch.save (neither its zip format nor the older one)")
    return [_unpickle(stream, name, budget) for _ in range(3)][-1]


def _budget(data: bytes) -> Budget:
    return Budget(max(4 * len(data), MIN_BUDGET_BYTES))


def _unpickle(stream: io.BytesIO, name: str, budget: Budget, read_storage: Callable[[str], bytes] | None = None) -> Any:
    """The data of the next pickle in the stream."""
    try:
        return plain(DataUnpickler(stream, budget, read_storage).load(), budget, done={})
    except Refused as error:
        raise UnsafeFileError(f"{name} was not read: {_short(error)}") from error
    except _MALFORMED as error:
        raise UserError(f"{name} is damaged, cut short or not a pickle ({_short(error)})") from error


def _read(source: Path | str | bytes, name: str | None) -> tuple[bytes, str]:
    if isinstance(source, bytes):
        data, name = source, name or "the data"
    else:
        data, name = read_bytes(source, MAX_FILE_BYTES), name or str(source)
    if not data:
        raise UserError(f"{name} is empty; write or copy it again")
    return data, name


def _short(error: Exception) -> str:
    """What went wrong, without the pages of the file that some reasons quote, nor what would steer a terminal."""
    text = str(error) or ("it ends before the pickle does" if isinstance(error, EOFError) else type(error).__name__)
    text = text if len(text) <= 400 else f"{text[:300]} ... {text[-80:]}"
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
