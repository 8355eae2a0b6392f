"""Where the benchmark draws, and waiting for it."""

from __future__ import annotations

import torch

from avatar.compute.device import CPU, interpreted


def device_of(backend: str) -> torch.device:
    return torch.device("cuda") if backend == "gpu" and not interpreted() else CPU


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done all that was launched."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
