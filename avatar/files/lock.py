"""One writer for each folder."""

from __future__ import annotations

import fcntl
import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from avatar.errors import UserError
from avatar.files.atomic import is_running
from avatar.files.read import read_json

LOCK_FILE = ".lock"


@contextmanager
def locked(folder: Path, otherwise: str = "choose another --out") -> Iterator[None]:
    """Hold the folder's lock; the system lets go of it when the process ends, however it ends.

    Folders that this made, and that nothing was written into, are gone afterwards. `otherwise` is what a person can do
    where it cannot be had.

    Raises UserError naming the process that holds it, and when the folder cannot be written.
    """
    path = folder / LOCK_FILE
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _acquire(path)
    except BlockingIOError:
        raise UserError(f"{folder} is being written by {_holder(path)}; wait for it, or {otherwise}") from None
    except OSError as error:
        raise UserError(f"{folder} cannot be written ({error.strerror}); {otherwise}") from None
    try:
        yield
    finally:
        with suppress(OSError):
            if _is_same(file, path):  # else the folder has another name, and this one may be another process's
                path.unlink()
        os.close(file)
        with suppress(OSError):  # it is not empty
            for place in made:
                place.rmdir()


def is_held(folder: Path) -> bool:
    """Whether a process works in the folder, as far as its lock file says; a lock that is asked is not taken."""
    try:
        holder = read_json(folder / LOCK_FILE)
        return holder["machine"] != platform.node() or is_running(holder["process"])
    except (UserError, KeyError, TypeError):
        return False


def _acquire(path: Path) -> int:
    """Raises BlockingIOError where another process holds it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)  # a link may name any file
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise
        if not _is_same(file, path):  # its holder deleted it between our opening and locking it
            os.close(file)
            continue
        os.truncate(file, 0)
        os.write(file, json.dumps({"process": os.getpid(), "machine": platform.node()}, allow_nan=False).encode())
        return file


def _is_same(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    try:
        holder = read_json(path)
        return f"process {holder['process']} on {holder['machine']}"
    except (UserError, KeyError, TypeError):
        return "another process"
