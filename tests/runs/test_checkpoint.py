from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
import torch

from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.runs.checkpoint import (
    Checkpoint,
    list_checkpoints,
    load_checkpoint,
    load_module,
    module_tensors,
    newest_checkpoint,
    save_checkpoint,
)


def checkpoint(step: int) -> Checkpoint:
    tensors = {"model.a": torch.randn(3, 2), "optimizer.a.step": torch.tensor(float(step))}
    return Checkpoint(step, tensors, {"data_hash": "x", "config": {"k": [1, None]}})


def test_what_is_saved_comes_back_to_the_bit(tmp_path: Path) -> None:
    saved = checkpoint(7)
    loaded = load_checkpoint(save_checkpoint(tmp_path, saved, keep=3))
    assert loaded.step == 7 and loaded.meta["config"] == {"k": [1, None]}
    assert loaded.tensors.keys() == saved.tensors.keys()
    assert all(torch.equal(loaded.tensors[k], saved.tensors[k]) for k in saved.tensors)


def test_the_newest_three_are_kept(tmp_path: Path) -> None:
    for step in (1, 2, 10, 100, 99_999_999):
        save_checkpoint(tmp_path, checkpoint(step), keep=3)
    assert [load_checkpoint(p).step for p in list_checkpoints(tmp_path)] == [10, 100, 99_999_999]


def test_a_checkpoint_that_is_not_finite_is_never_written(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, checkpoint(1), keep=3)
    bad = checkpoint(2)
    bad.tensors["model.a"][1, 1] = float("nan")
    with pytest.raises(UserError, match=r"step 2: model.a has 1 non-finite of 6 values, the first at \[1, 1\]"):
        save_checkpoint(tmp_path, bad, keep=1)
    assert [load_checkpoint(p).step for p in list_checkpoints(tmp_path)] == [1]


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    target = tmp_path / "file"
    write_atomically(target, b"old")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if call == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    elif call == "replace":
        monkeypatch.setattr(Path, "replace", full)
    else:
        monkeypatch.setattr(Path, "open", full)
    with pytest.raises(UserError, match="No space left on device"):
        write_atomically(target, b"new")
    monkeypatch.undo()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("keep", [0, 1, 7, 8, 100, 0.5, 0.99])
def test_a_truncated_checkpoint_is_named(tmp_path: Path, keep: float) -> None:
    path = save_checkpoint(tmp_path, checkpoint(3), keep=3)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep if keep in (0, 1) or keep > 1 else keep * len(data))])
    with pytest.raises(UserError, match=r"step_00000003.safetensors is damaged"):
        load_checkpoint(path)


def test_a_checkpoint_of_another_format_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, tmp_path / "step_00000001.safetensors")
    with pytest.raises(UserError, match="not a checkpoint of this program"):
        load_checkpoint(tmp_path / "step_00000001.safetensors")


def test_without_a_checkpoint_there_is_no_model(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no checkpoint; train first"):
        newest_checkpoint(tmp_path)


def test_a_module_takes_only_what_fits(tmp_path: Path) -> None:
    module = torch.nn.Linear(3, 2)
    fits = Checkpoint(1, {k: v.clone() + 1 for k, v in module_tensors(module).items()}, {})
    load_module(module, fits.tensors, tmp_path)
    assert torch.equal(module.bias, fits.tensors["model.bias"])
    with pytest.raises(UserError, match=r"model.weight of shape \[2, 3\], this model needs \[2, 4\]"):
        load_module(torch.nn.Linear(4, 2), fits.tensors, tmp_path)
    with pytest.raises(UserError, match=r"lacks model.bias"):
        load_module(module, {"model.weight": torch.zeros(2, 3)}, tmp_path)
