"""scripts/draw_mouth.py: mouths of several runs as a picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from lively import lively_run

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "draw_mouth.py"


def drawn(head: Path, out: Path, *runs: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, *runs, out, "--head", head, "--size", "128"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_each_run_is_a_row_of_mouths(open_mouth_folder: Path, tmp_path: Path) -> None:
    plain, toothed = (
        lively_run(open_mouth_folder, tmp_path / value, f"model.teeth={value}") for value in ("false", "true")
    )
    said = drawn(open_mouth_folder / "head_model", tmp_path / "mouths.png", plain, toothed)
    assert said.returncode == 0, said.stderr
    picture = cv2.imread(str(tmp_path / "mouths.png"))
    assert picture is not None and picture.shape == (2 * 192, 4 * 192, 3)
    above, below = picture.astype(np.int32).reshape(2, 192, 4 * 192, 3)
    assert np.abs(above - below).max() > 10, "two avatars"
    assert (above < 250).any(axis=2).mean() > 0.5, "skin and lips, and little of the background"


def test_a_head_without_a_mouths_opening_gets_a_sentence(tracked_folder: Path, tmp_path: Path) -> None:
    said = drawn(tracked_folder / "head_model", tmp_path / "x.png", lively_run(tracked_folder, tmp_path / "run"))
    assert said.returncode == 1 and said.stderr.strip().endswith("has no opening between the lips")
    assert not (tmp_path / "x.png").exists()
