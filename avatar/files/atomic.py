"""Files that are there whole or not at all."""

from __future__ import annotations

import itertools
import os
import platform
import re
from contextlib import suppress
from pathlib import Path

from avatar.errors import UserError
from avatar.files.names import shortened

_COUNTER = itertools.count()
_HOST = re.sub(r"[^0-9A-Za-z_]", "_", platform.node())[:40]


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that a crash, a kill or a full disk leaves the old file or the new one, never a part.

    The temporary file beside it has a name of its own in every process and call, so that two writers never mix.
    Raises UserError when the disk refuses.
    """
    temporary = temporary_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_overs(path)
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise UserError(f"{path} cannot be written ({error.strerror}); what was there before is untouched") from None


def temporary_name(path: Path) -> Path:
    """A name beside `path` that no other process or call uses, with the same suffix: encoders go by it."""
    return path.with_name(f".{shortened(path.stem)}.{_HOST}-{os.getpid()}-{next(_COUNTER)}.partial{path.suffix[-20:]}")


def is_running(pid: int) -> bool:
    """Whether this machine has a process of that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _remove_left_overs(path: Path) -> None:
    """Delete what writers of `path` that this machine's kernel no longer knows have left."""
    pattern = re.compile(
        rf"\.{re.escape(shortened(path.stem))}\.{re.escape(_HOST)}-([0-9]+)-[0-9]+\.partial{re.escape(path.suffix[-20:])}"
    )
    for other in path.parent.iterdir():
        if (match := pattern.fullmatch(other.name)) and not is_running(int(match[1])):
            with suppress(OSError):
                other.unlink()
