"""What an interrupted refinement has found so far, as a file."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save as serialize
from torch import Tensor

from avatar.data.tensor_file import read_metadata, read_tensors
from avatar.errors import UserError
from avatar.files.atomic import write_atomically

_MAX_PROGRESS = 2**28  # bytes
_MISSING = -1e30  # a figure of a frame without a head, which is NaN: files hold finite values


def read_progress(path: Path, key: str, values: int) -> tuple[list[Tensor], list[tuple[float, ...]]]:
    """Moves and figures of the frames that are done; none from a file that is damaged or of something else."""
    try:
        if read_metadata(path, _MAX_PROGRESS).get("key") != key:
            return [], []
        tensors = read_tensors(path, _MAX_PROGRESS)
        moves, figures = tensors["moves"], tensors["figures"]
    except (UserError, KeyError):
        return [], []
    if moves.shape[1:] != (values,) or figures.shape != (len(moves), 3):
        return [], []
    return list(moves), [tuple(row) for row in figures.masked_fill(figures == _MISSING, torch.nan).tolist()]


def write_progress(path: Path, key: str, moves: list[Tensor], figures: list[tuple[float, ...]]) -> None:
    tensors = {"moves": torch.stack(moves), "figures": torch.tensor(figures, dtype=torch.float64).nan_to_num(_MISSING)}
    write_atomically(path, serialize(tensors, metadata={"key": key}))
