"""What the progress bar shows, previews and curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_runs import train_small

from avatar.errors import UserError
from avatar.losses.photometric import PhotometricLoss
from avatar.runs.checkpoint import Checkpoint, newest_checkpoint, save_checkpoint
from avatar.runs.training_curves import read_curves
from avatar.train import trainer as trainer_module
from avatar.train.log import TrainingLog


def test_no_psnr_is_shown_before_one_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = torch.full((4, 4, 3), 0.5)
    loss = PhotometricLoss(*torch.ones(len(PhotometricLoss._fields)))
    with TrainingLog(tmp_path, 0, 3) as log:
        shown = []
        for step in (1, 2, 3):
            log.step(step, loss, image, image + 0.1)
            log._bar.refresh()
            shown.append(capsys.readouterr().err)
    assert "loss=1.0" in shown[0] and "psnr" not in shown[0]
    assert "psnr=20.00" in shown[1] and "psnr=20.00" in shown[2]


def test_a_preview_that_cannot_be_written_costs_no_checkpoint(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise UserError("no space")

    monkeypatch.setattr(TrainingLog, "preview", refused)
    with pytest.raises(UserError, match="no space"):
        train_small(tracked_folder, tmp_path / "run")
    assert newest_checkpoint(tmp_path / "run").step == 4


def test_a_kill_after_a_checkpoint_costs_no_point_of_the_curves(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(folder: Path, checkpoint: Checkpoint) -> None:
        save_checkpoint(folder, checkpoint)
        if checkpoint.step == 12:
            raise KeyboardInterrupt

    train_small(tracked_folder, tmp_path / "whole")
    monkeypatch.setattr(trainer_module, "save_checkpoint", killed)
    with pytest.raises(KeyboardInterrupt):
        train_small(tracked_folder, tmp_path / "killed")
    assert newest_checkpoint(tmp_path / "killed").step == 12
    curves = read_curves(tmp_path / "whole")
    assert curves[-1, 0] == 12 and np.array_equal(read_curves(tmp_path / "killed"), curves)
