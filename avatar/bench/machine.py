"""What a figure belongs to: processor, threads and versions; and how to hold a measurement to some of them."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from avatar.splat import splat
from avatar.splat.scenes import head_camera, head_shell
from avatar.version import __version__

SIMD = ("baseline", "avx2", "avx512")


def describe_machine() -> dict[str, Any]:
    """The machine and the versions, for the JSON of every benchmark; `load` is what else ran in the last minute."""
    return {
        "avatar": __version__,
        "torch": torch.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor_name(),
        "processors": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "simd": available_simd(),
        "load": round(os.getloadavg()[0], 2),
    }


def processor_name() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def available_simd() -> list[str]:
    """The instruction sets that this build and this processor have, slowest first."""
    found = []
    for name in SIMD:
        try:
            with limited_to(threads=1, simd=name):
                splat(head_shell(1), head_camera(8), torch.zeros(3))
        except ValueError:
            continue
        found.append(name)
    return found


@contextmanager
def limited_to(*, threads: int, simd: str = "") -> Iterator[None]:
    """Let torch and the compiled core work with so many threads and one instruction set ("": the best there is)."""
    names, threads_before = ("AVATAR_THREADS", "AVATAR_SIMD"), torch.get_num_threads()
    before = {name: os.environ.get(name) for name in names}
    torch.set_num_threads(threads)
    os.environ.update(AVATAR_THREADS=str(threads), AVATAR_SIMD=simd)
    try:
        yield
    finally:
        torch.set_num_threads(threads_before)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
