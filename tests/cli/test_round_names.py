"""Training in rounds on a tracked folder of any name."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.pipeline import refine_plan

pytestmark = pytest.mark.slow


def test_a_tracked_folder_may_be_called_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, out = write_tracked_folder(tmp_path / "run", frames=14, size=40), tmp_path / "out"
    monkeypatch.setattr(refine_plan, "FIRST_STEPS", 4)
    words = ("--frame-offset", 1, "--refine", 1, *SMALL, "trainer.iterations=10")
    assert "10/10" in avatar("train", folder, "--out", out, *words)
    assert "is complete" in avatar("train", "--resume", out)
