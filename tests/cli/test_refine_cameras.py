"""Training in rounds on folders of several cameras, as a user meets it."""

from __future__ import annotations

from pathlib import Path

import pytest
from camera_rig_folder import write_single
from command_line import avatar
from small_runs import SMALL

from avatar.pipeline import refine_plan

pytestmark = pytest.mark.slow

QUICK = [*SMALL, "trainer.iterations=10"]


@pytest.mark.parametrize("cameras", ["12", "07,12", "front"])
def test_some_of_several_cameras_are_trained_on_in_rounds(
    cameras: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, run = write_single(tmp_path), tmp_path / "run"
    monkeypatch.setattr(refine_plan, "FIRST_STEPS", 4)
    words = ("--head", tmp_path / "head_model", "--cameras", cameras, "--refine", 1)
    assert "10/10" in avatar("train", folder, "--out", run, *words, *QUICK)
    assert "is complete" in avatar("train", "--resume", "--out", run, "--cameras", cameras)
