"""How many processors this process may use, and no more threads than that."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

# Of either version of Linux's interface: microseconds of processor time, and in how many of them.
_CGROUP = Path("/sys/fs/cgroup")
_LIMITS = ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")


def processor_count() -> int:
    """Those that the process may run on, within a container's limit (`docker run --cpus`)."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(allowed, container_limit() or allowed)


def container_limit() -> int | None:
    """Whole processors, at least one; None where there is no limit."""
    for names in _LIMITS:
        with suppress(OSError, ValueError):  # "max" is none
            quota, period = (int(word) for name in names for word in (_CGROUP / name).read_text().split())
            if quota > 0 and period > 0:
                return math.ceil(quota / period)
    return None


def limit_threads() -> None:
    """Before PyTorch is imported, which looks at the machine and not at a container's limit: threads beyond it wait for
    each other until the next period. OMP_NUM_THREADS overrides this."""
    if container_limit() is not None:
        os.environ.setdefault("OMP_NUM_THREADS", str(processor_count()))
