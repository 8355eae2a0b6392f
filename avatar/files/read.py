"""Opens every file that a person names or that lies in a folder of theirs: a regular file of bounded size.

Reading a FIFO waits for a writer that may never come. A device or a sparse file has more bytes than there is memory.
"""

from __future__ import annotations

import codecs
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from avatar.errors import UserError

MAX_JSON_BYTES = 2**26  # of the files of a run or a sweep
_KINDS: Mapping[int, str] = {
    stat.S_IFIFO: "a named pipe (FIFO)",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}
_NO_WAITING = os.O_NONBLOCK | os.O_CLOEXEC


class MissingFile(UserError):
    """Nothing has this name."""


def is_there(path: Path) -> bool:
    """Whether anything has this name, be it a file, a FIFO or a link to nothing. Reading it says which."""
    return os.path.lexists(path)


def open_file(path: Path | str, limit: int | None) -> BinaryIO:
    """A regular file of at most `limit` bytes, opened for reading; None: of any size.

    Raises MissingFile, or UserError naming the file and why it is not read.
    """
    try:
        _check(path, Path(path).stat(), limit)  # before it is opened: opening some devices changes them
        descriptor = os.open(path, os.O_RDONLY | _NO_WAITING)
        try:
            _check(path, os.fstat(descriptor), limit)  # another file may have taken the name
            return os.fdopen(descriptor, "rb")
        except BaseException:
            os.close(descriptor)
            raise
    except FileNotFoundError:
        raise MissingFile(f"{path} does not exist") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None
    except ValueError as error:  # a zero byte in the name
        raise UserError(f"{str(path)!r} cannot be read ({error})") from None


def check_file(path: Path | str, limit: int | None) -> None:
    """Raise as `open_file` does. For libraries that open the file by its name."""
    open_file(path, limit).close()


def read_bytes(path: Path | str, limit: int) -> bytes:
    """The bytes of a file. Raises as `open_file` does."""
    with open_file(path, limit) as file:
        try:
            data = file.read(os.fstat(file.fileno()).st_size + 1)
            while len(data) <= limit and (more := file.read(2**20)):  # it grows, or the system says that it is empty
                data += more
        except OSError as error:
            raise UserError(f"{path} cannot be read ({error.strerror})") from None
    if len(data) > limit:
        raise _too_large(path, len(data), limit)
    return data


def read_text(path: Path | str, limit: int) -> str:
    """The text of a file in UTF-8, or in UTF-16 with a byte order mark, as editors on Windows save it, without that mark.

    Raises as `open_file` does.
    """
    data = read_bytes(path, limit)
    try:
        return data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text (byte {error.start}); save it as UTF-8") from None


def read_json(path: Path | str, limit: int = MAX_JSON_BYTES) -> Any:
    """What a JSON file holds. Raises as `open_file` does."""
    data = read_bytes(path, limit)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as JSON ({error})") from None


def shown_size(count: int) -> str:
    """Bytes as people write them."""
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("KB", 10**3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


def _check(path: Path | str, status: os.stat_result, limit: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"{path} is {_KINDS.get(stat.S_IFMT(status.st_mode), 'something else')}, not a file")
    if limit is not None and status.st_size > limit:
        raise _too_large(path, status.st_size, limit)


def _too_large(path: Path | str, size: int, limit: int) -> UserError:
    return UserError(f"{path} has {shown_size(size)}; files of its kind are read up to {shown_size(limit)}")
