"""Checks of shape and finiteness that answer in one sentence, tensors as 8-bit levels, and rows of tensors."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


def check_shapes(**tensors_and_shapes: tuple[Tensor, str]) -> dict[str, int]:
    """Check `name=(tensor, "N 3")` pairs; a name stands for one size across all pairs, `_` for any size.

    Returns the sizes that the names were bound to. Raises TypeError for a non-tensor, ValueError for a wrong shape; both
    messages name the tensor, what was expected and what was given.
    """
    bound: dict[str, int] = {}
    owner: dict[str, str] = {}
    for name, (tensor, spec) in tensors_and_shapes.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name} must be a torch.Tensor of shape [{spec}], not {type(tensor).__name__}")
        dims = spec.split()
        shape = tuple(tensor.shape)
        if len(shape) != len(dims):
            raise ValueError(f"{name} must have shape [{', '.join(dims)}], got {list(shape)}")
        for dim, size in zip(dims, shape, strict=True):
            if dim == "_":
                continue
            if dim.isdigit():
                if int(dim) != size:
                    raise ValueError(f"{name} must have shape [{', '.join(dims)}], got {list(shape)}")
            elif bound.setdefault(dim, size) != size:
                raise ValueError(
                    f"{name} has {dim} = {size}, but {owner[dim]} has {dim} = {bound[dim]}; they must be the same"
                )
            else:
                owner.setdefault(dim, name)
    return bound


def describe_non_finite(name: str, tensor: Tensor) -> str | None:
    """None when every value is finite, else a sentence with the count and the first index."""
    bad = ~torch.isfinite(tensor)
    count = int(bad.sum())
    if count == 0:
        return None
    first = bad.nonzero()[0].tolist()
    value = tensor[tuple(first)].item()
    return f"{name} has {count} non-finite of {tensor.numel()} values, the first at {first} ({value})"


def check_finite(**tensors: Tensor) -> None:
    """Raise ValueError with name, count and first index of non-finite values."""
    for name, tensor in tensors.items():
        message = describe_non_finite(name, tensor)
        if message is not None:
            raise ValueError(message)


def to_8_bit(values: Float[Tensor, "..."], truncate: bool = False) -> UInt8[Tensor, "..."]:
    """256 levels of the values clamped to [0, 1]: the nearest one, or with `truncate` the one below."""
    scaled = values.detach().clamp(0.0, 1.0) * 255.0
    return (scaled.floor() if truncate else scaled.round()).to(torch.uint8)


def take_rows(values: Float[Tensor, "..."], rows: Int[Tensor, "..."], dim: int = 0) -> Float[Tensor, "..."]:
    """`values[rows]`, whose gradient has the same bits every time: `dim` becomes the dimensions of `rows`.

    The gradient of a row that is taken twice is a sum. Threads of a CPU add up that of `values[rows]` in any order, threads
    of a GPU that of `index_select`.
    """
    flat, dim = rows.reshape(-1), dim % values.ndim
    taken = values.index_select(dim, flat) if values.device.type == "cpu" else values[(slice(None),) * dim + (flat,)]
    return taken.unflatten(dim, rows.shape)
