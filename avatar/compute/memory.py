"""How much memory there is, and a sentence where that is not enough."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from avatar.errors import UserError

_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


class Need(NamedTuple):
    """What takes memory, and what would take less."""

    what: str
    size: int  # bytes
    lower: str  # keys of the configuration, or options


def check_memory(doing: str, needs: Sequence[Need], available: float | None = None) -> None:
    """Raise UserError, with both figures and what to lower, when the needs are more than there is.

    doing      what needs them, as a sentence begins: "training"
    available  bytes; by default what `available_bytes` says
    """
    available = available_bytes() if available is None else available
    total = sum(need.size for need in needs)
    if total <= available:
        return
    largest = max(needs, key=lambda need: need.size)
    raise UserError(
        f"{doing} needs about {in_words(total)} of memory, and {in_words(available)} are available; {largest.what} takes "
        f"{in_words(largest.size)} of it: lower {largest.lower}"
    )


def in_words(size: float) -> str:
    """Bytes as people write them, in MiB or GiB."""
    return f"{size / 2**30:,.1f} GiB" if size >= 2**30 else f"{size / 2**20:,.0f} MiB"


def available_bytes() -> float:
    """Memory that a new process can have: what the system says is available, within a container's limit.

    Infinite where the system does not say.
    """
    found = [float("inf")]
    with suppress(OSError, ValueError, IndexError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")))
    if len(found) == 1:
        with suppress(OSError, ValueError, AttributeError):
            found.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    for limit in _CGROUP_LIMITS:
        with suppress(OSError, ValueError):
            found.append(float(limit.read_text()))
    return min(found)
