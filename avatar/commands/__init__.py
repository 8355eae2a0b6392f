"""What each command does, on top of the library: the file of its name. It is imported when it is called, and not before."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from importlib import import_module


def find_command(name: str) -> Callable[[Namespace], int]:
    """What does the command `name`; it returns the exit status."""
    word = name.replace("-", "_")
    return getattr(import_module(f"{__name__}.{word}"), f"run_{word}")
