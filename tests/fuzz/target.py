"""What is fuzzed: valid files to start from, and what reads them."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Reader = tuple[Path | None, Callable[[bytes], object]]  # the file to put the bytes into, if any; what reads them


@dataclass(frozen=True)
class Target:
    """Valid files and what reads them; `weight` is the share of the cases."""

    seeds: list[bytes]
    reader: Reader
    weight: float = 1.0
    wrap: Callable[[bytes], bytes] = bytes  # makes a file of mutated contents, with checksums that fit


def on_disk(path: Path, read: Callable[[Path], object]) -> Reader:
    return path, lambda _: read(path)


def of_copy(place: Path, file: Path, folder: Path, read: Callable[[Path], object]) -> Reader:
    """Reads a copy of `folder`, made in `place`, in which `file` is another one."""
    copy = place / f"copy of {folder.name} for {file.name}"
    shutil.copytree(folder, copy)
    return copy / file.relative_to(folder), lambda _: read(copy)


def member(archive: bytes, ending: str) -> bytes:
    """The file in a .zip archive whose name ends so."""
    with zipfile.ZipFile(io.BytesIO(archive)) as members:
        return members.read(next(name for name in members.namelist() if name.endswith(ending)))


def with_member(archive: bytes, ending: str, content: bytes) -> bytes:
    """The archive with another content of that file, and checksums that fit."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(buffer, "w") as new:
        for name in old.namelist():
            new.writestr(name, content if name.endswith(ending) else old.read(name))
    return buffer.getvalue()
