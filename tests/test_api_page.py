"""The code of docs/api.md runs as it stands."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import torch
from small_runs import train_small
from tracked_folder import write_tracked_folder

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"


def test_the_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_tracked_folder(tmp_path / "someone", frames=330, size=24)
    train_small(folder, tmp_path / "runs" / "anna", ["trainer.iterations=2"])
    shutil.copytree(folder / "head_model", tmp_path / "head_model")
    (tmp_path / "motion.csv").write_text("time,expression_0,jaw_x,jaw_y,jaw_z\n0,0,0,0,0\n0.1,0.5,0.1,0,0\n")
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 2 and len(blocks[0].splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    for block in blocks:
        exec(compile(block.replace("size=512", "size=48"), str(PAGE), "exec"), found)
    assert found["picture"].shape == (24, 24, 3) and found["rendering"].image.shape == (48, 48, 3)
    assert len(found["gaussians"].means) == len(found["anna"].avatar)
    assert len(found["pictures"]) == 2 and not torch.equal(*found["pictures"])
    assert found["far"].dtype == torch.bool
