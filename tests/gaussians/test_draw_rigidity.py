"""scripts/draw_rigidity.py: the learned shares as a picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lively import lively_run
from safetensors.torch import load_file, safe_open, save_file

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "draw_rigidity.py"


def drawn(run: Path, out: Path, head: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, run, out, "--frames", "1", "3", "--head", head, "--size", "48"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("logit", "red"), [(9.0, True), (-9.0, False)])
def test_the_skulls_gaussians_are_red_and_the_skins_are_blue(
    tracked_folder: Path, tmp_path: Path, logit: float, red: bool
) -> None:
    file = lively_run(tracked_folder, tmp_path / "run", "model.rigidity=true") / "avatar.safetensors"
    with safe_open(file, "pt") as opened:
        described = opened.metadata()
    tensors = load_file(file)
    tensors["model.rigidity_logits"] = torch.full_like(tensors["model.rigidity_logits"], logit)
    tensors["model.opacity_logits"] += 9.0
    save_file(tensors, file, described)
    said = drawn(tmp_path / "run", tmp_path / "shares.png", tracked_folder / "head_model")
    assert said.returncode == 0, said.stderr
    picture = cv2.imread(str(tmp_path / "shares.png"))
    assert picture is not None and picture.shape == (96, 96, 3)
    shares = picture[len(picture) // 2 :].astype(np.int32)
    painted = shares.min(axis=2) < 100
    assert painted.mean() > 0.1
    assert ((shares[..., 2] > shares[..., 0]) == red)[painted].mean() > 0.95


def test_an_avatar_without_shares_gets_a_sentence(tracked_folder: Path, tmp_path: Path) -> None:
    lively_run(tracked_folder, tmp_path / "run", "model.rigidity=false")
    said = drawn(tmp_path / "run", tmp_path / "shares.png", tracked_folder / "head_model")
    assert said.returncode == 1 and said.stderr.strip().endswith("train one with model.rigidity=true")
    assert not (tmp_path / "shares.png").exists()
