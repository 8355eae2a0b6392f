"""Names of files and folders: those that come out of files must not choose where something is written."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from pathlib import Path
from typing import Any

SUBJECT_FOLDER, RUN_FOLDER, ROUNDS_FOLDER = "subject", "run", "rounds"  # names that the program gives
MAX_NAME_BYTES = 100  # in UTF-8; file systems take 255, and suffixes follow
_FORBIDDEN = frozenset('/\\:*?"<>|')  # separators, and what Windows refuses
_NOT_AT_THE_ENDS = " .-~"  # hidden files, options, home folders


def safe_name(text: str) -> str:
    """`text` as a name without folders, of printable letters and at most `MAX_NAME_BYTES`; `unnamed` for nothing."""
    letters = "".join(letter if letter.isprintable() and letter not in _FORBIDDEN else "_" for letter in text)
    short = letters.lstrip(_NOT_AT_THE_ENDS).encode()[:MAX_NAME_BYTES].decode(errors="ignore")
    return short.rstrip(_NOT_AT_THE_ENDS) or "unnamed"


def as_text(name: str) -> str:
    """`name` with what is not Unicode escaped: a path may hold it, and no page can show it."""
    return name.encode(errors="backslashreplace").decode()


def typed(path: Path) -> str:
    """A path as it is typed in a command that is printed."""
    return shlex.quote(str(path))


def shortened(name: str) -> str:
    """`name`, so short that something can be put before and behind it; a long one ends in its hash."""
    data = os.fsencode(name)
    if len(data) <= MAX_NAME_BYTES:
        return name
    return f"{data[: MAX_NAME_BYTES - 9].decode(errors='ignore')}-{hashlib.sha256(data).hexdigest()[:8]}"


def display_path(folder: Path) -> Path:
    """The end of an absolute path that begins with a name a person gave: `me/run` of what `avatar create` made in `me`."""
    parts = folder.parts
    first = len(parts) - 1
    while first > 1 and parts[first] in (SUBJECT_FOLDER, RUN_FOLDER):
        first -= 3 if parts[first - 2] == ROUNDS_FOLDER else 1
    return Path(*parts[first:])


def display_name(folder: Path) -> str:
    return next(iter(display_path(folder).parts), "")


def natural_order(name: str) -> tuple[Any, ...]:
    """A key that sorts number 10 after number 9, padded or not."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((int(part[:300]), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts if part)
