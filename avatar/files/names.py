"""Names for files and folders of our own, after names that others gave."""

from __future__ import annotations

LONGEST = 60  # bytes; file systems take 255, and some of them are needed for what is put before and behind


def safe_name(name: str) -> str:
    """A name that every file system and every text takes: characters that cannot be printed become _, and it is cut."""
    printable = "".join(character if character.isprintable() else "_" for character in name)
    return printable.encode()[:LONGEST].decode(errors="ignore").strip() or "_"
