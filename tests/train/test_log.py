"""What the progress bar shows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from avatar.losses.photometric import PhotometricLoss
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
