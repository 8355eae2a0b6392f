"""Files and folders that are there whole or not at all."""

from __future__ import annotations

import itertools
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from avatar.errors import UserError
from avatar.files.names import shortened

_COUNTER = itertools.count()
_CLEANED: set[Path] = set()  # folders whose left-overs this process has removed
_HOST = re.sub(r"[^0-9A-Za-z_]", "_", platform.node())[:40]
_LEFT_OVER = re.compile(rf"\..+\.{_HOST}-([0-9]+)-[0-9]+\.partial.{{0,20}}")


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that a crash, a kill or a full disk leaves the old file or the new one, never a part.

    The temporary file beside it has a name of its own in every process and call, so that two writers never mix.
    Raises UserError when the disk refuses.
    """
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_overs(path.parent)
        temporary, file = _new_file(path)
        with file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
        raise UserError(f"{path} cannot be written ({error.strerror}); what was there before is untouched") from None


def refuse_current(target: Path) -> None:
    """Raise UserError for `.`: a folder that is written whole gets its name at the end."""
    if not target.name:
        raise UserError(f"{target} is the folder that this runs in, which is not replaced; choose another --out")


def check_target(target: Path) -> None:
    """Raise UserError where a new folder may not be written: nothing is overwritten."""
    refuse_current(target)
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise UserError(f"{target} exists already and is not a folder; choose another --out")
    if target.is_dir() and any(target.iterdir()):
        raise UserError(f"{target} exists already and is not empty; choose another --out, or remove it")


@contextmanager
def whole_folder(
    target: Path, put: Callable[[Path, Path], object] = Path.replace, advice: str = "choose another --out"
) -> Iterator[Path]:
    """A folder beside `target` that takes its place when nothing went wrong, and else is removed.

    put      gives the folder its name; by default `target` must not be there, or be an empty folder
    advice   what to do where nothing can be written
    Raises UserError when the disk refuses.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{shortened(target.name)}-", dir=target.parent))
    except OSError as error:
        raise UserError(f"nothing can be written in {target.parent} ({error.strerror}); {advice}") from None
    try:
        yield building
        building.chmod(0o777 & ~_umask())
        put(building, target)
    except OSError as error:
        raise UserError(f"{target} cannot be written ({error.strerror or error}); nothing was left behind") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _umask() -> int:
    """What a process may only read by setting it."""
    os.umask(mask := os.umask(0o077))
    return mask


def temporary_name(path: Path) -> Path:
    """A name beside `path` that no other process or call uses, with the same suffix: encoders go by it."""
    return path.with_name(f".{shortened(path.stem)}.{_HOST}-{os.getpid()}-{next(_COUNTER)}.partial{path.suffix[-20:]}")


def _new_file(path: Path) -> tuple[Path, BinaryIO]:
    """A temporary file beside `path`, open. One of its name may be there: a container that was killed starts again with the
    same process numbers, each of which counts anew."""
    while True:
        temporary = temporary_name(path)
        with suppress(FileExistsError):
            return temporary, temporary.open("xb")


def is_running(pid: int) -> bool:
    """Whether this machine has a process of that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _remove_left_overs(folder: Path) -> None:
    """Delete what writers that this machine's kernel no longer knows have left; listed once, not for every picture."""
    if (folder := folder.absolute()) in _CLEANED:
        return
    _CLEANED.add(folder)
    for other in folder.iterdir():
        if (match := _LEFT_OVER.fullmatch(other.name)) and other.is_file() and not is_running(int(match[1])):
            with suppress(OSError):
                other.unlink()
