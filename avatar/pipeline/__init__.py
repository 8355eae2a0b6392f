"""From a folder or video to its result: what the commands and the benchmarks run."""

from __future__ import annotations

OK, INTERRUPTED = 0, 130  # exit statuses
