"""Whether this machine has a GPU, seen without PyTorch, which takes a second to import."""

from __future__ import annotations

from pathlib import Path

# Of NVIDIA's driver, of AMD's, and of NVIDIA's in Windows' Linux.
_FILES = ("/dev/nvidiactl", "/dev/kfd", "/usr/lib/wsl/lib/libcuda.so.1")


def has_gpu_driver() -> bool:
    return any(Path(file).exists() for file in _FILES)
