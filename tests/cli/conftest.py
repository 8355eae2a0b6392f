"""A run that several files' tests look at and none changes."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import avatar
from small_runs import QUICK


@pytest.fixture(scope="session")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    output = avatar("train", tracked_folder, "--out", run, "--frame-offset", 1, "--size", 40, "--seed", 3, *QUICK)
    assert "16/16" in output and "loss=" in output and "psnr=" in output
    assert f"avatar eval {run}" in output
    return run
