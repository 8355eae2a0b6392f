"""Files and folders whose names are as long as they can be, or not UTF-8."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import avatar
from small_runs import SMALL

pytestmark = pytest.mark.slow

ODD = os.fsdecode(b"caf\xe9")
LONG = "x" * 240


@pytest.fixture(scope="module")
def place(trained: Path, tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose name is not UTF-8, with a subject and a run of it."""
    place = tmp_path_factory.mktemp("odd") / ODD
    try:
        place.mkdir()
    except OSError:
        pytest.skip("this file system takes names in UTF-8 only")
    shutil.copytree(trained, place / "run")
    shutil.copytree(tracked_folder, place / "someone")
    np.savez(place / f"{LONG}.npz", expression=np.zeros((2, 3), np.float32))
    return place


def test_an_error_about_a_name_that_no_terminal_shows_is_a_sentence(place: Path) -> None:
    words = [sys.executable, "-m", "avatar.cli", "compare", str(place / "none"), str(place / "none")]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(words, env=environment, capture_output=True, check=False)
    assert done.returncode == 1 and b"does not exist" in done.stderr and b"Traceback" not in done.stderr


def test_evaluating_and_comparing(place: Path) -> None:
    run, head = place / "run", place / "someone" / "head_model"
    avatar("eval", run, "--folder", place / "someone", "--head", head, "--protocol", "strict")
    avatar("compare", run, run, "--out", place / ODD)
    assert "caf" in (place / ODD / "compare.csv").read_text(encoding="utf-8")


def test_training(place: Path) -> None:
    words = ("--frame-offset", 1, "--out", place / "another run", *SMALL, "trainer.iterations=2")
    avatar("train", place / "someone", *words)
    assert (place / "another run" / "curves.csv").is_file() and (place / "another run" / "avatar.safetensors").is_file()


@pytest.mark.parametrize("suffix", [".ply", ".safetensors", ".mp4"])
@pytest.mark.parametrize("name", ["x" * 255, ODD])
def test_exports(name: str, suffix: str, place: Path) -> None:
    out = place / f"{name[: 255 - len(suffix)]}{suffix}"
    avatar("export", place / "run", "--head", place / "someone" / "head_model", "--out", out)
    assert out.stat().st_size > 0


@pytest.mark.parametrize("out", [None, f"{'y' * 251}.mp4"])
def test_reenacting(out: str | None, place: Path) -> None:
    words = ["--head", place / "someone" / "head_model", "--driver", place / f"{LONG}.npz"]
    avatar("reenact", place / "run", *words, *(["--out", place / out] if out else []))
    videos = list((place if out else place / "run" / "reenact").glob("*.mp4"))
    assert any(video.name == out if out else video.name.startswith("xxx") for video in videos)


def test_checking(place: Path) -> None:
    avatar("check", place / "someone", "--frame-offset", 1, "--out", place / "page")
    assert (place / "page" / "index.html").read_text(encoding="utf-8")
