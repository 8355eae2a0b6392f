"""The demo: of tracked folders, of filmed people, and gone on with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.commands import demo
from avatar.files.third_party import FOLDER_VARIABLE
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint
from avatar.runs.run import read_run_info


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "RECIPE", [*SMALL, "trainer.iterations=16"])


@pytest.mark.slow
def test_an_interrupted_demo_goes_on(tmp_path: Path) -> None:
    """Interrupted in its training, it does not present the half-trained avatar the next time."""
    for name in ("actor", "driver"):
        write_tracked_folder(tmp_path / "demo" / name, frames=30, size=48, seed=1)
    avatar("train", tmp_path / "demo" / "actor", "--out", tmp_path / "demo" / "run", *SMALL, "trainer.iterations=16")
    run = tmp_path / "demo" / "run"
    list_checkpoints(run / "checkpoints")[-1].unlink()
    before = newest_checkpoint(run)
    assert before.step == 12
    output = avatar("demo", tmp_path / "demo")
    assert "Resuming" in output and "The demo is done" in output
    page = tmp_path / "demo" / "avatar.html"
    last = output.rstrip().splitlines()[-1]
    assert "Open this first" in last and str(page) in last and page.stat().st_size > 10**5
    assert len([line for line in output.splitlines() if "\r" not in line]) < 40, "nothing is lost above it"
    assert newest_checkpoint(run).step == 16
    means = json.loads((run / "eval" / "results.json").read_bytes())["protocols"]["strict"]["means"]
    assert f"PSNR {means['psnr_head']:.2f}" in output, "the whole avatar is measured"


@pytest.mark.slow
def test_people_are_filmed_and_tracked_where_that_is_possible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracking is another test's: here it leaves a folder without a head model, as it does."""
    out, videos = tmp_path / "demo", []

    def tracked(video: Path, folder: Path, head: Path, *_: Any, **__: Any) -> None:
        videos.append((video.name, video.stat().st_size > 0, head))
        write_tracked_folder(folder, frames=30, size=48)
        shutil.rmtree(head)
        (folder / "head_model").rename(head)

    monkeypatch.setattr(demo, "tracking_lacks", list)
    monkeypatch.setattr(demo, "track", tracked)
    monkeypatch.setattr(demo, "VIDEO_SIZE", 64)
    for person in ("ACTOR", "DRIVER"):
        monkeypatch.setattr(demo, person, getattr(demo, person)._replace(frames=3))
    output = avatar("demo", out)
    head = out / "head_model"
    assert videos == [("actor.mp4", True, head), ("driver.mp4", True, head)]
    assert "The demo is done" in output and f"{out / 'actor.mp4'}" in output
    source = read_run_info(out / "run").source
    assert (source.folder, source.head) == ((out / "actor").resolve(), head.resolve())
    again = avatar("demo", out)
    assert "The demo is done" in again and len(videos) == 2, "what is there is not made again"


def test_what_tracking_lacks_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path))
    made: list[str] = []
    monkeypatch.setattr(demo, "make_tracked", lambda person, out: made.append(person.name))
    output = avatar("demo", tmp_path / "demo", status=1)  # nothing was made
    assert "pip install '.[track]'" in output or "face_landmarker.task" in output
    assert made == ["actor", "driver"]
