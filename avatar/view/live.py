"""What drives an avatar live, whatever it comes from, and how late that is on the screen."""

from __future__ import annotations

import statistics
import threading
from collections import deque
from typing import NamedTuple

from avatar.types import Camera, HeadParams

SHORT = 2.0  # seconds that rate and latency on the page are of


class LiveFrame(NamedTuple):
    """A frame as the avatar shows it."""

    number: int  # another one for another frame
    params: HeadParams
    camera: Camera | None = None  # holds the head's pose; None: at rest
    taken: float | None = None  # seconds of `time.monotonic`, when its picture was taken or its packet came


class LiveTiming:
    """Latency and rate of the live frames that were drawn lately."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._drawn: deque[tuple[float, float]] = deque()  # when, and how long after it was taken; seconds
        self._last: float | None = None

    def add(self, taken: float, now: float) -> None:
        """A frame's picture has gone out; the same frame in another size counts once."""
        with self._lock:
            if taken != self._last:
                self._last = taken
                self._drawn.append((now, now - taken))
            self._forget(now)

    def now(self, now: float) -> tuple[float, float] | None:
        """Median latency in milliseconds, and pictures a second; None where nothing came lately."""
        with self._lock:
            self._forget(now)
            if len(self._drawn) < 2:
                return None
            passed = self._drawn[-1][0] - self._drawn[0][0]
            latency = statistics.median(late for _, late in self._drawn)
            return 1000 * latency, (len(self._drawn) - 1) / max(passed, 1e-6)

    def _forget(self, now: float) -> None:
        while self._drawn and now - self._drawn[0][0] > SHORT:
            self._drawn.popleft()
