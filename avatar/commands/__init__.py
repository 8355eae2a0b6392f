"""What each command does, on top of the library. A command's module is imported when it is called, and not before."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from importlib import import_module

OK, INTERRUPTED = 0, 130

MODULES = {
    "train": "rounds",
    "eval": "measuring",
    "refine": "refining",
    "report": "measuring",
    "compare": "measuring",
    "track": "tracking",
    "reenact": "driving",
    "drive-file": "driving",
    "export": "exporting",
    "prepare": "preparing",
    "check": "preparing",
    "demo-data": "demonstrating",
    "demo": "demonstrating",
    "bench": "benchmarking",
    "sweep": "sweeping",
    "doctor": "diagnosing",
    "models": "third_party",
}


def find_command(name: str) -> Callable[[Namespace], int]:
    """What does the command `name`; it returns the exit status."""
    module = import_module(f"{__name__}.{MODULES[name]}")
    return getattr(module, f"run_{name.replace('-', '_')}")
