"""The order in which points begin to take part, and when."""

from __future__ import annotations

import functools
import shutil
from pathlib import Path

import pytest
import torch
from heads import grid_head
from small_runs import train_small

from avatar.baselines.monogaussianavatar import active_count, evenly_ordered
from avatar.gaussians.uv import UVTexels, uv_texels
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint, save_checkpoint
from avatar.train import trainer as trainer_module


def test_a_set_doubles_at_every_tenth_of_the_training() -> None:
    found = [active_count(step, 1000, 1600) for step in (0, 99, 100, 199, 200, 300, 399, 400, 1000)]
    assert found == [100, 100, 200, 200, 400, 800, 800, 1600, 1600]
    assert active_count(0, 1000, 5) == 1 and active_count(7, 7, 5) == 5
    assert all(active_count(3 * step, 30, 1600) == active_count(step, 10, 1600) for step in range(11))


def test_every_beginning_is_spread_over_the_map() -> None:
    row, column = torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij")
    texels = UVTexels(row.flatten(), column.flatten(), torch.arange(256), torch.rand(256, 3), torch.full((256,), 16))
    ordered = evenly_ordered(texels)
    assert sorted(ordered.face.tolist()) == list(range(256))
    for part in range(4):  # in each prefix every block of the map has as many as any other
        chosen = slice(0, 16 << part)
        blocks = torch.bincount(ordered.row[chosen] // 4 * 4 + ordered.column[chosen] // 4, minlength=16)
        assert blocks.tolist() == [1 << part] * 16
    again = texels.face[ordered.row * 16 + ordered.column]
    assert torch.equal(again, ordered.face) and torch.equal(ordered.barycentric, texels.barycentric[ordered.face])


def test_a_heads_texels_stay_themselves() -> None:
    texels = uv_texels(grid_head(), 20)
    ordered = evenly_ordered(texels)
    before = {(r, c): f for r, c, f in zip(*(values.tolist() for values in texels[:3]), strict=True)}
    assert before == {(r, c): f for r, c, f in zip(*(values.tolist() for values in ordered[:3]), strict=True)}


def test_a_run_that_is_resumed_before_its_points_grow_has_the_same_bits(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = ["model=monogaussianavatar", "trainer.iterations=48", "trainer.checkpoint_every=4"]
    monkeypatch.setattr(trainer_module, "save_checkpoint", functools.partial(save_checkpoint, keep=12))
    train_small(tracked_folder, tmp_path / "whole", overrides)
    shutil.copytree(tmp_path / "whole", tmp_path / "broken")
    for path in list_checkpoints(tmp_path / "broken" / "checkpoints")[1:]:
        path.unlink()
    begun = newest_checkpoint(tmp_path / "broken")
    assert begun.step == 4, "the points grow after a tenth of the steps"
    train_small(tracked_folder, tmp_path / "broken", overrides, resume=begun)
    whole, broken = newest_checkpoint(tmp_path / "whole"), newest_checkpoint(tmp_path / "broken")
    assert [name for name in whole.tensors if not torch.equal(whole.tensors[name], broken.tensors[name])] == []
