"""A sweep at a glance: how many jobs are done, what failed and why, and when it will all be over."""

from __future__ import annotations

import shutil
import sys
import time
from collections import Counter
from collections.abc import Mapping
from typing import TextIO

from avatar.sweep.state import State

ORDER = ("done", "running", "waiting", "failed")
SHOWN_FAILURES = 10


def overview(states: Mapping[str, State], workers: int | None = None) -> list[str]:
    """Counts, the mean time of a job, the expected end, running jobs and failures with their sentences."""
    counts = Counter(state.status for state in states.values())
    head = ", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status] or status == "done")
    lines = [f"{len(states)} jobs: {head}"]
    finished = [state.seconds for state in states.values() if state.status == "done"]
    if finished:
        mean = sum(finished) / len(finished)
        line = f"  a job takes {duration(mean)}"
        left = counts["running"] + counts["waiting"]
        at_a_time = workers or max(counts["running"], 1)
        if left:
            line += f"; the rest about {duration(mean * left / at_a_time)} with {at_a_time} at a time"
        lines.append(line)
    lines += [f"  running  {name}" for name, state in states.items() if state.status == "running"][:SHOWN_FAILURES]
    failed = [(name, state) for name, state in states.items() if state.status == "failed"]
    lines += [f"  failed   {name}: {state.sentence}" for name, state in failed[:SHOWN_FAILURES]]
    if len(failed) > SHOWN_FAILURES:
        lines.append(f"  and {len(failed) - SHOWN_FAILURES} more failures; --status lists them all")
    return lines


def full_table(states: Mapping[str, State]) -> list[str]:
    """A line for every job."""
    width = max(map(len, states), default=3)
    lines = [f"{'job':{width}}  status   attempts      time  "]
    for name, state in states.items():
        lines.append(
            f"{name:{width}}  {state.status:8} {state.attempts:8} {duration(state.seconds):>9}  {state.sentence}".rstrip()
        )
    return lines


def duration(seconds: float) -> str:
    """`42 s`, `3 min 20 s`, `2 h 05 min`."""
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return f"{total // 60} min {total % 60:02d} s"
    return f"{total // 3600} h {total % 3600 // 60:02d} min"


class Progress:
    """Rewrites its lines in place on a terminal; elsewhere it prints a job once when something becomes of it."""

    REDRAW_SECONDS = 1.0

    def __init__(self, workers: int | None = None, out: TextIO | None = None) -> None:
        self._out = out or sys.stdout
        self._workers = workers
        self._drawn = 0
        self._last = -self.REDRAW_SECONDS
        self._known: dict[str, str] = {}

    def show(self, states: Mapping[str, State], last: bool = False) -> None:
        if self._out.isatty():
            if last:
                self._redraw(overview(states, self._workers))
            elif time.monotonic() - self._last >= self.REDRAW_SECONDS:
                width, height = shutil.get_terminal_size()  # what is wider or higher could not be rewritten
                self._redraw([line[: width - 1] for line in overview(states, self._workers)[: height - 1]])
            return
        for name, state in states.items():
            if state.status in ("done", "failed") and self._known.get(name) != state.status:
                sentence = f": {state.sentence}" if state.sentence else f" in {duration(state.seconds)}"
                print(f"{state.status:7} {name}{sentence}", file=self._out, flush=True)
            self._known[name] = state.status
        if last:
            print(overview(states)[0], file=self._out, flush=True)

    def _redraw(self, lines: list[str]) -> None:
        self._last = time.monotonic()
        up = f"\x1b[{self._drawn}A" if self._drawn else ""
        self._out.write(up + "".join(f"\x1b[2K{line}\n" for line in lines) + "\x1b[0J")
        self._out.flush()
        self._drawn = len(lines)
