"""Files of a sequence, one a frame: NAME-00000.png, NAME-00001.png and so on for NAME.png."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from avatar.files.names import shortened


def numbered(out: Path, number: int) -> Path:
    """Where the file of a frame is written."""
    return out.with_name(f"{shortened(out.stem)}-{number:05d}{out.suffix}")


def existing(out: Path) -> list[Path]:
    """The files of the sequence's names that there are."""
    name = re.compile(rf"{re.escape(shortened(out.stem))}-\d{{5,}}{re.escape(out.suffix)}")
    return [path for path in out.parent.glob("*") if name.fullmatch(path.name)]


def remove_longer(out: Path, count: int, say: Callable[[str], None]) -> None:
    """Remove what an earlier, longer run wrote: the files from `count` on, up to the first number without one."""
    end = count
    while (path := numbered(out, end)).is_file():
        path.unlink()
        end += 1
    if end > count:
        say(f"Removed {numbered(out, count)} to {numbered(out, end - 1).name}, of an earlier run")
