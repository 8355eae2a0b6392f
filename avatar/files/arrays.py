"""Reading of numpy's files (.npz, .npy), and what all readers of foreign binary files share: bounds and plain words."""

from __future__ import annotations

import io
import math
import pickle
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from avatar.errors import UserError

MAX_FILE_BYTES = 2**30  # FLAME's largest pickle has 53 MB
MALFORMED = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, RecursionError)
MALFORMED += (EOFError, struct.error, pickle.UnpicklingError)  # what reading nonsense as a pickle runs into
BAD_ZIP = (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError)  # the same for an archive


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; pickled objects inside are refused. Raises UserError naming the file."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(info.file_size for info in members) > MAX_FILE_BYTES:
                raise UserError(f"{path} would unpack to more than {MAX_FILE_BYTES} bytes; such files are not read")
            return {info.filename.removesuffix(".npy"): _parse_npy(archive.read(info), path) for info in members}
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist") from error
    except (*MALFORMED, *BAD_ZIP, zlib.error) as error:
        raise UserError(f"{path} is damaged or not a .npz file ({shortened(error)})") from error


def load_npy(path: Path) -> np.ndarray:
    """The array of a .npy file; pickled objects are refused. Raises UserError naming the file."""
    data, _ = read_bytes(path, None)
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
        return flat.reshape(shape, order="F" if is_fortran else "C").copy()
    except (*MALFORMED, SyntaxError, tokenize.TokenError) as error:
        raise UserError(f"{path} is damaged or holds no numpy arrays ({shortened(error)})") from error


def read_bytes(source: Path | str | bytes, name: str | None) -> tuple[bytes, str]:
    """The file's bytes and its name for messages; `source` may be the bytes themselves."""
    if isinstance(source, bytes):
        data, name = source, name or "the data"
    else:
        path = Path(source)
        name = name or str(path)
        try:
            size = path.stat().st_size
            if size > MAX_FILE_BYTES:
                raise UserError(f"{name} has {size} bytes; files of more than {MAX_FILE_BYTES} bytes are not read")
            with path.open("rb") as file:
                data = file.read(size)  # a device has no size and no end
        except OSError as error:
            raise UserError(f"{name} cannot be read: {error.strerror}") from error
    if not data:
        raise UserError(f"{name} is empty; write or copy it again")
    return data, name


def shortened(error: Exception) -> str:
    """What went wrong, without the pages of the file that some reasons quote, nor what would steer a terminal."""
    text = str(error) or ("it ends before the pickle does" if isinstance(error, EOFError) else type(error).__name__)
    text = text if len(text) <= 400 else f"{text[:300]} ... {text[-80:]}"
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
