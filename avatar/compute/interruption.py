"""Ctrl-C and SIGTERM as a flag, so that work ends where it can be gone on with."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def interruption(second_acts: bool = True) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a flag that the loop reads between steps; a second one acts at once.

    Without `second_acts` it sets the flag again: for work that takes no more than moments to complete.

    A signal that is ignored (a job in the background of a shell, nohup) stays ignored, and outside the main thread the
    signals are somebody else's.
    """
    caught = False
    previous: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        nonlocal caught
        caught = True
        if second_acts:
            signal.signal(number, previous[number])

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:
                previous[number] = signal.signal(number, note)
    try:
        yield lambda: caught
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
