"""Things that have a file's name and are no file that can be read."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path


def make_sparse(path: Path) -> None:
    """20 GB that take no place on the disk."""
    with path.open("wb") as file:
        file.truncate(20 * 10**9)


def make_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's path is at most 107 bytes long
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(here)


# What it is -> how it is made, and a word of the sentence that refuses it.
SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    "a FIFO": (os.mkfifo, "FIFO"),
    "an endless device": (lambda path: path.symlink_to("/dev/zero"), "a device"),
    "a sparse file of 20 GB": (make_sparse, "20.0 GB"),
    "a socket": (make_socket, "a socket"),
}
