"""Reads safetensors files: plain numbers, all of them finite, no more than memory holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from torch import Tensor

from avatar.compute.memory import available_bytes
from avatar.errors import UserError
from avatar.files.opening import check_file, shown_size
from avatar.tensors import describe_non_finite

DTYPES = ("F64", "F32", "F16", "BF16", "I64", "I32", "I16", "I8", "U8", "BOOL")  # PyTorch computes with no others


def read_metadata(path: Path, limit: int) -> Mapping[str, str]:
    """The texts in the header of a file of at most `limit` bytes.

    Raises MissingFile, or UserError naming the file and what is wrong with it.
    """
    check_file(path, limit)
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}
    except (SafetensorError, OSError, ValueError) as error:
        raise _damaged(path, error) from None


def read_tensors(path: Path, limit: int) -> dict[str, Tensor]:
    """The tensors by name, in memory of their own.

    Raises as `read_metadata` does, and UserError naming the tensor for one that is not finite or not of `DTYPES`.
    """
    check_file(path, limit)
    size, free = path.stat().st_size, available_bytes()
    if size > free:
        raise UserError(f"{path} has {shown_size(size)}, and {shown_size(int(free))} of memory are free")
    tensors: dict[str, Tensor] = {}
    try:
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 (not a dict)
                if (dtype := file.get_slice(name).get_dtype()) not in DTYPES:
                    raise UserError(f"{path} cannot be used: {name} has values of type {dtype}, not of {_known()}")
                # A copy: in a file a tensor may lie at any address, and some products are rounded by where operands lie.
                tensors[name] = file.get_tensor(name).clone()
    except (SafetensorError, OSError, ValueError) as error:
        raise _damaged(path, error) from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and (message := describe_non_finite(name, tensor)):
            raise UserError(f"{path} cannot be used: {message}")
    return tensors


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} is damaged or no safetensors file ({error})")


def _known() -> str:
    return ", ".join(DTYPES)
