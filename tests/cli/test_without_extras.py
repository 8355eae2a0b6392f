"""What runs where matplotlib is not installed, and what says that it needs it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL

INSTALL = "pip install '.[plots]'"


@pytest.fixture(autouse=True)
def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # type: ignore[arg-type]


def test_training_and_evaluating_work_and_say_what_is_missing(tracked_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *SMALL, "trainer.iterations=2")
    assert (run / "curves.csv").is_file()
    (run / "eval").mkdir()
    (run / "eval" / "curves.png").write_text("of an earlier evaluation")
    said = avatar("eval", run, "--protocol", "strict")
    assert f"curves.png needs matplotlib: {INSTALL}" in said and "Results" in said
    assert not (run / "eval" / "curves.png").exists() and (run / "eval" / "worst.png").is_file()
    assert f"a report needs matplotlib: {INSTALL}" in avatar("report", run, status=1)


def test_checking_works_and_its_page_needs_them(tracked_folder: Path, tmp_path: Path) -> None:
    assert "ready to train" in avatar("check", tracked_folder, "--frame-offset", 1)
    said = avatar("check", tracked_folder, "--frame-offset", 1, "--out", tmp_path / "page", status=2)
    assert INSTALL in said and "ready to train" not in said, "before the long work"
    assert INSTALL in avatar("bench", "splat", "--quick", "--out", tmp_path / "bench", status=1)
