"""What a cached folder held when it was written: a cut file or a flipped bit is noticed, and the folder made again."""

from __future__ import annotations

from pathlib import Path

from avatar.errors import UserError
from avatar.files.lock import LOCK_FILE
from avatar.files.read import read_text
from avatar.files.third_party import sha256_of

CONTENTS_FILE = "contents.sha256"  # in the format of sha256sum
_OTHERS = {CONTENTS_FILE, LOCK_FILE}  # which are not hashed
_MAX_BYTES = 2**26  # of it: half a million files


def write_contents(folder: Path) -> None:
    """Write the hash of every file into `CONTENTS_FILE`."""
    lines = [f"{sha256_of(path)}  {name}\n" for name, path in _files(folder).items()]
    (folder / CONTENTS_FILE).write_text("".join(lines), encoding="utf-8")


def find_damage(folder: Path) -> str | None:
    """What is not as `write_contents` found it; None where all is. Files that were added do not count."""
    try:
        lines = read_text(folder / CONTENTS_FILE, _MAX_BYTES).splitlines()
        recorded = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    except UserError:
        return f"{CONTENTS_FILE} is missing or cannot be read"
    try:
        files = _files(folder)
    except OSError as error:  # such as: another process moves it away
        return f"its files cannot be listed ({error.strerror})"
    for name, digest in recorded.items():
        try:
            if name not in files or sha256_of(files[name]) != digest:
                return f"{name} is {'missing' if name not in files else 'not what was written'}"
        except UserError:
            return f"{name} cannot be read"
    return None if recorded else f"{CONTENTS_FILE} is empty"


def _files(folder: Path) -> dict[str, Path]:
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in _OTHERS)
    return {path.relative_to(folder).as_posix(): path for path in found}
