"""The checkpoints of a run.

    RUN/checkpoints/step_00001000.safetensors     parameters and optimizer state; step and hashes in its header

A checkpoint is one file, written to a temporary name, flushed to the disk and renamed, so that it is there whole or not
at all; its JSON is the header of the same file, so the two cannot disagree. Reading one cannot execute code.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as serialize
from torch import Tensor

from avatar.data.tensor_file import read_metadata, read_tensors
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.names import typed
from avatar.tensors import describe_non_finite

CHECKPOINT_FORMAT = 3
KEPT = 3  # checkpoints of a run, the newest
_MAX_BYTES = 2**34  # an avatar and the optimizer's two moments of it
_MODEL = "model."  # begins the names of parameters
_NAME = re.compile(r"step_\d{8}\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """The state after `step` optimizer steps."""

    step: int
    tensors: Mapping[str, Tensor]  # "model.*" and "optimizer.*"
    meta: Mapping[str, Any]  # head_fingerprint, data_hash, split, config


def save_checkpoint(folder: Path, checkpoint: Checkpoint, keep: int = KEPT) -> Path:
    """Write RUN/checkpoints/step_N.safetensors and delete all but the newest `keep`.

    Raises UserError, and writes nothing, when a tensor holds a value that is not finite.
    """
    for name, tensor in checkpoint.tensors.items():
        if message := describe_non_finite(name, tensor):
            raise UserError(
                f"step {checkpoint.step}: {message}; the checkpoint was not written, the last good one stays"
            )
    meta = {"format": CHECKPOINT_FORMAT, "step": checkpoint.step, **checkpoint.meta}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()}
    path = folder / f"step_{checkpoint.step:08d}.safetensors"
    write_atomically(path, serialize(tensors, metadata={"avatar": json.dumps(meta, allow_nan=False)}))
    for old in list_checkpoints(folder)[:-keep]:
        with suppress(OSError):  # an old checkpoint too many is no reason to stop a run
            old.unlink()
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return sorted(p for p in folder.glob("step_*.safetensors") if _NAME.fullmatch(p.name))


def load_checkpoint(path: Path) -> Checkpoint:
    """Read one checkpoint; UserError when it is damaged or of another format."""
    try:
        meta = json.loads(read_metadata(path, _MAX_BYTES).get("avatar", "null"))
        tensors = read_tensors(path, _MAX_BYTES)
    except (UserError, ValueError, RecursionError) as error:
        raise UserError(
            f"the checkpoint {path} is damaged ({error}); delete it to use the one before, or train anew"
        ) from None
    if not isinstance(meta, dict) or meta.get("format") != CHECKPOINT_FORMAT or not isinstance(meta.get("step"), int):
        found = meta.get("format") if isinstance(meta, dict) else "none"
        raise UserError(f"{path} is not a checkpoint of this program (format {found}, expected {CHECKPOINT_FORMAT})")
    return Checkpoint(meta["step"], tensors, meta)


def newest_checkpoint(run: Path) -> Checkpoint:
    """The last checkpoint of a run; UserError when there is none: an untrained model is never used silently."""
    files = list_checkpoints(run / "checkpoints")
    if not files:
        raise UserError(f"{run} holds no checkpoint; train first (avatar train SUBJECT --out {typed(run)})")
    return load_checkpoint(files[-1])


def newest_step(run: Path) -> int | None:
    """Of the last checkpoint of a run, without reading it; None when there is none."""
    return max((int(path.stem.removeprefix("step_")) for path in list_checkpoints(run / "checkpoints")), default=None)


def module_tensors(module: torch.nn.Module) -> dict[str, Tensor]:
    """The parameters of a module under the names that checkpoints give them."""
    return {f"{_MODEL}{name}": value for name, value in module.state_dict().items()}


def load_module(module: torch.nn.Module, tensors: Mapping[str, Tensor], source: Path | str) -> None:
    """Put the parameters among a file's tensors into a module; UserError naming the first that does not fit."""
    own = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    check_fit(own, tensors, source)
    try:
        module.load_state_dict({name: tensors[f"{_MODEL}{name}"] for name in own})
    except ValueError as error:
        raise UserError(f"the avatar in {source} is damaged: it {error}; copy it again, or train again") from None


def check_fit(own: Mapping[str, tuple[int, ...]], tensors: Mapping[str, Tensor], source: Path | str) -> None:
    """Raise UserError naming the first of a file's parameters that does not have the shape in `own`."""
    given = {name.removeprefix(_MODEL): value for name, value in tensors.items() if name.startswith(_MODEL)}
    for name in sorted(own.keys() | given.keys()):
        if name not in given or name not in own:
            where = "lacks" if name not in given else "has, but this model lacks,"
            raise UserError(f"the avatar in {source} {where} {_MODEL}{name}; it belongs to another model")
        if own[name] != tuple(given[name].shape):
            raise UserError(
                f"the avatar in {source} has {_MODEL}{name} of shape {list(given[name].shape)}, this model needs "
                f"{list(own[name])}; it belongs to another model or head model"
            )
