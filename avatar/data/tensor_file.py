"""Reads safetensors files: plain numbers, all of them finite, no more than memory holds."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

from avatar.compute.memory import available_bytes
from avatar.errors import UserError
from avatar.files.read import check_file, shown_size
from avatar.tensors import describe_non_finite

DTYPES = ("F64", "F32", "F16", "BF16", "I64", "I32", "I16", "I8", "U8", "BOOL")  # PyTorch computes with no others


def read_metadata(path: Path, limit: int) -> Mapping[str, str]:
    """The texts in the header of a file of at most `limit` bytes.

    Raises MissingFile, or UserError naming the file and what is wrong with it.
    """
    with _opened(path, limit) as file:
        return file.metadata() or {}


def read_tensors(path: Path, limit: int) -> dict[str, Tensor]:
    """The tensors by name, in memory of their own.

    Raises as `read_metadata` does, and UserError naming the tensor for one that is not finite or not of `DTYPES`.
    """
    tensors: dict[str, Tensor] = {}
    with _opened(path, limit) as file:
        size, free = path.stat().st_size, available_bytes()
        if size > free:
            raise UserError(f"{path} has {shown_size(size)}, and {shown_size(int(free))} of memory are free")
        for name in file.keys():  # noqa: SIM118 (not a dict)
            if (dtype := file.get_slice(name).get_dtype()) not in DTYPES:
                raise UserError(f"{path} cannot be used: {name} has values of type {dtype}, not of {', '.join(DTYPES)}")
            # A copy: in a file a tensor may lie at any address, and some products are rounded by where operands lie.
            tensors[name] = file.get_tensor(name).clone()
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and (message := describe_non_finite(name, tensor)):
            raise UserError(f"{path} cannot be used: {message}")
    return tensors


@contextmanager
def _opened(path: Path, limit: int) -> Iterator[Any]:
    check_file(path, limit)
    with ExitStack() as stack:
        try:
            yield stack.enter_context(safe_open(_in_utf8(path, stack), framework="pt"))
        except (SafetensorError, OSError, ValueError) as error:
            raise UserError(f"{path} is damaged or no safetensors file ({error})") from None


def _in_utf8(path: Path, stack: ExitStack) -> Path:
    """A name of the file that the library takes: it knows no other encoding."""
    try:
        str(path).encode()
        return path
    except UnicodeEncodeError:
        link = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "link"
        link.symlink_to(path.resolve())
        return link
