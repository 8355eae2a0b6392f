"""How the compiled kernels run: their threads and their instruction set."""

from __future__ import annotations

import torch

from avatar import _core


def thread_count() -> int:
    """Threads that a kernel uses: the variable AVATAR_THREADS, or as many as torch does."""
    text = _core.environment("AVATAR_THREADS")
    if text is None:
        return torch.get_num_threads()
    if not (text.isascii() and text.isdigit()) or not 1 <= int(text) <= 1024:
        raise ValueError(f"AVATAR_THREADS must be a number of threads from 1 to 1024, got {text!r}")
    return int(text)


def instruction_set() -> str:
    """The variable AVATAR_SIMD (baseline, avx2 or avx512; the kernels refuse another); "" is the best there is."""
    return _core.environment("AVATAR_SIMD") or ""
