"""How much memory this process can still get, and a sentence where that is not enough."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from avatar.errors import UserError

_UNLIMITED = 1 << 60  # control groups without a limit name some number near 2^63


class Need(NamedTuple):
    """What takes memory, and what would take less."""

    what: str
    size: int  # bytes
    lower: str  # keys of the configuration, or options


def check_memory(doing: str, needs: Sequence[Need], available: int | None = None) -> None:
    """Raise UserError, with both figures and what to lower, when the needs are more than there is.

    doing      what needs them, as a sentence begins: "training"
    available  bytes; by default what `available_memory` says, without which nothing is checked
    """
    available = available_memory() if available is None else available
    total = sum(need.size for need in needs)
    if available is None or total <= available:
        return
    largest = max(needs, key=lambda need: need.size)
    raise UserError(
        f"{doing} needs about {in_words(total)} of memory, and {in_words(available)} are available; {largest.what} takes "
        f"{in_words(largest.size)} of it: lower {largest.lower}"
    )


def in_words(size: int) -> str:
    """Bytes as people write them, in MiB or GiB."""
    return f"{size / 2**30:,.1f} GiB" if size >= 2**30 else f"{size / 2**20:,.0f} MiB"


def available_memory(root: Path = Path("/")) -> int | None:
    """Bytes that can be allocated before the system has to take them from somebody: on Linux what is free or can be freed
    at once, with swap, and no more than the process's control group (container) allows; elsewhere all that the machine
    has. None where even that is not known.
    """
    free = _of_linux(root)
    return _of_machine() if free is None else min([free, *_left_to_groups(root)])


def _of_linux(root: Path) -> int | None:
    """MemAvailable and SwapFree of /proc/meminfo."""
    try:
        lines = (root / "proc/meminfo").read_text(encoding="ascii").splitlines()
        kilobytes = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines) if rest}
        return 1024 * (kilobytes["MemAvailable"] + kilobytes.get("SwapFree", 0))
    except (OSError, ValueError, KeyError, IndexError):
        return None


def _of_machine() -> int | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no such function
        return None


def _left_to_groups(root: Path) -> Iterator[int]:
    """What each control group that holds the process still allows, of both versions of Linux's interface."""
    try:
        groups = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return
    for line in groups:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers == "":
            mount, names = root / "sys/fs/cgroup", ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            mount = root / "sys/fs/cgroup/memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        inside = PurePosixPath(path.lstrip("/"))
        for group in (inside, *inside.parents):  # a container sees its own group as the root
            left = _left_to_group(mount / group, *names)
            if left is not None:
                yield left


def _left_to_group(group: Path, limit: str, usage: str, reclaimable: str) -> int | None:
    try:
        allowed, used = (int((group / name).read_text(encoding="ascii")) for name in (limit, usage))
        statistics = dict(line.split() for line in (group / "memory.stat").read_text(encoding="ascii").splitlines())
        cached = int(statistics.get(reclaimable, 0))
    except (OSError, ValueError):  # no such group, or "max"
        return None
    return max(allowed - max(used - cached, 0), 0) if allowed < _UNLIMITED else None
