"""avatar create with everything that tracking needs: from a raw video."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL

from avatar.commands import create
from avatar.commands.arguments import parse
from data_prep.formats.avatar_track import read_info

FRAMES = 30


@pytest.mark.slow
def test_a_video_becomes_a_page(tracking_models: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(create, "parse", lambda words: parse([*words, *SMALL]))
    assert "avatar create me.mp4" in avatar("demo-data", "me.mp4", "--video", "--size", 256, "--frames", FRAMES)
    words = ("create", "me.mp4", "--head", "head_model", "--anyway")
    output = avatar(*words)
    for part in (f"about {FRAMES} frames", "quality of the tracking", "Stage 2 of 4", "Round 1 of 1", "Done in"):
        assert part in output
    strict = json.loads(Path("me/run/eval/results.json").read_text())["protocols"]["strict"]
    tracked, fitted = (f"PSNR {one['means']['psnr_head']:.2f}" for one in (strict["tracked"], strict))
    line = next(line for line in output.splitlines() if line.startswith("Held-out frames: "))
    assert line.startswith(f"Held-out frames: {tracked}, ") and f"(tracked); {fitted}, " in line
    assert line.endswith("(refined, fitted) over 6 of them, head only")
    assert len(list(Path("me/subject/frames").iterdir())) == FRAMES
    page = Path("me/avatar.html").read_bytes()
    again = avatar(*words)
    assert "me/subject holds this tracking already" in again and Path("me/avatar.html").read_bytes() == page
    avatar("demo-data", "other.mp4", "--video", "--size", 256, "--frames", 4, "--seed", 1)
    refused = avatar("create", "other.mp4", "--head", "head_model", "--out", "me", status=1)
    assert "is not this tracking" in refused
    assert read_info(Path("me/subject")).source["video"] == "me.mp4"
