"""Where tensors are, and what may be done with them there."""

from __future__ import annotations

import os

import torch
from torch import Tensor

CPU = torch.device("cpu")


def interpreted() -> bool:
    """Whether Triton interprets kernels on the CPU, which is slow and for tests: the variable TRITON_INTERPRET."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def on_gpu(tensor: Tensor) -> bool:
    """Whether the kernels of `avatar.kernels` take the tensor.

    It is on a GPU; or on torch's meta device, where tensors have shapes only and nothing is computed; or on the CPU, where
    Triton interprets.
    """
    kind = tensor.device.type
    return kind in ("cuda", "meta") or (kind == "cpu" and interpreted())


def visible_gpus() -> list[str]:
    """The GPUs that torch sees, as CUDA_VISIBLE_DEVICES names them for another process."""
    count, named = torch.cuda.device_count(), os.environ.get("CUDA_VISIBLE_DEVICES")
    names = map(str, range(count)) if named is None else (name.strip() for name in named.split(","))
    return [name for name in names if name][:count]


def to_device(tensor: Tensor, device: torch.device) -> Tensor:
    """The tensor on `device`; to a GPU the copy is made while the program goes on."""
    if tensor.device == device:
        return tensor
    if device.type == "cuda" and tensor.is_cpu and not tensor.requires_grad:
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


def free_bytes(device: torch.device) -> float | None:
    """What is free of a GPU's memory; None for the CPU, whose `avatar.compute.memory.available_bytes` tells."""
    return float(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else None
