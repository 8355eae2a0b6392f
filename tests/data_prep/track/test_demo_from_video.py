"""The demo with everything that tracking needs: from two raw videos."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL

from avatar.commands import demo
from avatar.runs.run import read_run_info
from data_prep.formats.avatar_track import read_info

FRAMES = 16


@pytest.mark.slow
def test_the_demo_begins_with_videos(tracking_models: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "RECIPE", SMALL)
    monkeypatch.setattr(demo, "VIDEO_SIZE", 256)
    for person in ("ACTOR", "DRIVER"):
        monkeypatch.setattr(demo, person, getattr(demo, person)._replace(frames=FRAMES))
    out = tmp_path / "demo"
    output = avatar("demo", out)
    assert "looking for the face" in output and "The demo is done" in output and str(out / "actor.mp4") in output
    for name in ("actor", "driver"):
        assert read_info(out / name).source["video"] == f"{name}.mp4"
        assert len(list((out / name / "frames").iterdir())) == FRAMES
    source = read_run_info(out / "run").source
    assert (source.folder, source.head) == (out / "actor", out / "head_model")
    assert (out / "run" / "reenact" / "driver-relative.mp4").stat().st_size > 1000
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
