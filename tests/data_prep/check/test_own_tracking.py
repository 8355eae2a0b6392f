"""The check page of a folder that avatar track wrote."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from avatar.errors import UserError
from avatar.files.video import video_writer
from data_prep.check import own_tracking
from data_prep.check.own_tracking import tracking_sections
from data_prep.formats.avatar_track import TrackingInfo, write_tracking
from data_prep.formats.metrical_tracker import read_tracking


@pytest.fixture
def folder(tracked_folder: Path, tmp_path: Path) -> Path:
    tracks = read_tracking({0: tracked_folder / "checkpoint" / "00000.frame"}).frames
    figures = [
        {"name": "landmark error", "value": 1.23456, "unit": "% eyes", "grade": "fair", "advice": "look <again>"},
        {"name": "blinks", "value": 4, "unit": "", "grade": "good", "advice": "blink"},
    ]
    info = TrackingInfo(
        25.0, 48, 48, (100.0, 100.0, 24.0, 24.0), "assumed: a lens", True, "head", "0" * 64, {},
        notes=("the video is HDR",), quality={"figures": figures},
    )  # fmt: skip
    write_tracking(tmp_path, dataclasses.replace(info), tracks)
    return tmp_path


def test_figures_lens_and_notes_are_shown(folder: Path) -> None:
    page = "".join(tracking_sections(folder))
    for part in (
        "landmark error",
        "1.235",
        "fair",
        '<td>landmark error<div class="soft">look &lt;again&gt;</div></td>',
        "Focal length: assumed: a lens.",
        "The video is HDR.",
    ):
        assert part in page
    assert ">blink<" not in page and "<video" not in page  # advice only where it is needed


def test_the_video_is_inside_the_page_unless_it_is_large(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "overlay").mkdir()
    (folder / "overlay" / "overlay.mp4").write_bytes(b"film")
    assert 'src="data:video/mp4;base64,ZmlsbQ=="' in "".join(tracking_sections(folder))
    monkeypatch.setattr(own_tracking, "MAX_EMBEDDED", 3)
    page = "".join(tracking_sections(folder))
    assert "<video" not in page and "overlay.mp4" in page and str(folder) not in page


def test_the_videos_first_picture_is_shown_before_it_starts(folder: Path) -> None:
    with video_writer(folder / "overlay" / "overlay.mp4", 25) as add:
        for level in (200, 20):
            add(np.full((32, 48, 3), level, np.uint8))
    found = re.search(r'poster="data:image/jpeg;base64,([^"]+)"', "".join(tracking_sections(folder)))
    assert found
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (32, 48, 3) and abs(picture.mean() - 200) < 5


def test_folders_of_others_have_none_of_it(tracked_folder: Path) -> None:
    assert tracking_sections(tracked_folder) == []


LARGE = f'[{{"value": 1{"0" * 400}}}]'


@pytest.mark.parametrize("figures", ["5", '["x"]', '[{"value": 1e999}]', LARGE, '[{"value": "x"}]'])
def test_figures_of_no_tracking_are_refused(folder: Path, figures: str) -> None:
    told = json.loads((folder / "tracking.json").read_text())
    told["quality"] = {"figures": "HERE"}
    (folder / "tracking.json").write_text(json.dumps(told).replace('"HERE"', figures))
    with pytest.raises(UserError, match=r"tracking\.json (is damaged|cannot be read)"):
        tracking_sections(folder)
