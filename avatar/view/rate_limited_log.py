"""What goes wrong with clients, as counted lines: thousands of the same become one line a minute."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

SILENCE = 60.0  # seconds between two lines of the same kind
MAX_KINDS = 64


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # stderr is closed
        print(line, file=sys.stderr, flush=True)


class RateLimitedLog:
    def __init__(self, say: Callable[[str], object] = _print, clock: Callable[[], float] = time.monotonic) -> None:
        self._say, self._clock = say, clock
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._told: dict[str, tuple[float, int]] = {}  # when, and the count then

    def add(self, kind: str) -> None:
        """`kind` is a sentence of this program's, without what strangers sent."""
        with self._lock:
            if kind not in self._counts and len(self._counts) >= MAX_KINDS:
                kind = "other trouble with a client"
            self._counts[kind] = self._counts.get(kind, 0) + 1
            if kind not in self._told or self._clock() - self._told[kind][0] >= SILENCE:
                self._print_count(kind)

    def close(self) -> None:
        """Say the counts that have grown since they were said."""
        with self._lock:
            for kind, count in self._counts.items():
                if count > self._told[kind][1]:
                    self._print_count(kind)

    def _print_count(self, kind: str) -> None:
        count = self._counts[kind]
        self._told[kind] = self._clock(), count
        self._say(f"Viewer: {kind}" + (f" ({count} times)" if count > 1 else ""))
