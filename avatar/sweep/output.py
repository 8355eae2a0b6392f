"""What a job says, in a file of bounded size: NAME has the newest of it, NAME.old what came before."""

from __future__ import annotations

import io
from pathlib import Path

from avatar.errors import UserError
from avatar.files.read import open_file

MAX_BYTES = 2**22  # of each of the two files


class BoundedLog(io.TextIOBase):
    """Adds to a file, as text or bytes, from its end. A full one takes the place of the old one."""

    def __init__(self, path: Path, limit: int = MAX_BYTES) -> None:
        self._path, self._limit = path, limit
        self._file = path.open("ab", buffering=0)

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.write_bytes(text.encode(errors="backslashreplace"))
        return len(text)

    def write_bytes(self, data: bytes) -> None:
        if self._file.tell() + len(data) > self._limit:
            self._file.close()
            self._path.replace(old_of(self._path))
            self._file = self._path.open("ab", buffering=0)
        self._file.write(data[-self._limit :])

    def close(self) -> None:
        if "_file" in self.__dict__:  # it could be opened
            self._file.close()
        super().close()


def old_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.old")


def end_of(path: Path, size: int = 4096) -> bytes:
    """The last bytes of a file that this program writes; nothing where there is none."""
    try:
        with open_file(path, None) as file:
            file.seek(max(0, file.seek(0, io.SEEK_END) - size))
            return file.read(size)
    except (UserError, OSError):
        return b""


def last_line(said: bytes) -> str:
    """Of what a command said, without the program's name; empty where it said nothing."""
    lines = said.decode(errors="replace").strip().splitlines()
    return lines[-1].removeprefix("avatar: ") if lines else ""
