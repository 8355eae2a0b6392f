"""Tracked folders with something wrong: one sentence each, naming the file or frame and what to do."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from bad_folders import CASES
from folder_damage import FRAMES
from tracked_folder import write_head_model, write_tracked_folder

from avatar.data.source import Source
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.prepare.prepare import prepare


@pytest.fixture(scope="module")
def good_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("good") / "subject", FRAMES)


@pytest.mark.parametrize("name", CASES)
def test_bad_folder(name: str, good_folder: Path, tmp_path: Path) -> None:
    edit, sentence = CASES[name]
    folder = tmp_path / "subject"
    shutil.copytree(good_folder, folder)
    head = load_head_assets(folder / "head_model")
    edit(folder)
    with pytest.raises(UserError) as error:
        prepare(Source(folder, folder / "head_model"), head, out=tmp_path / "out", say=lambda _: None)
    message = str(error.value)
    assert re.search(sentence, message), message
    assert "\n" not in message
    assert {path.name for path in tmp_path.iterdir()} <= {"subject"}, "a refused folder leaves nothing behind"


def prepare_with(folder: Path, out: Path, test_frames: int | None = None, **options: Any) -> Path:
    head = folder / "head_model"
    return prepare(Source(folder, head, **options), load_head_assets(head), out=out, test_frames=test_frames, say=str)


OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "tracking folder missing": ({"tracking": "nowhere"}, r"the tracking folder .*nowhere does not exist"),
    "tracking folder empty": ({"tracking": "."}, r"neither .* holds \.frame files"),
    "offset without overlap": (
        {"frame_offset": 500},
        r"no image belongs to a tracking frame under offset 500: images are 24 files numbered 00001",
    ),
    "offset far off": ({"frame_offset": 12}, r"11 of 24 images have no partner under offset 12"),
    "too many test frames": (
        {"test_frames": 24},
        r"24 test frames cannot be held out of 24: choose from 1 to 23",
    ),
    "no test frames": ({"test_frames": 0}, r"0 test frames cannot be held out of 24"),
    "frame rate of zero": ({"fps": 0.0}, r"--fps must be above 0 and at most 1000, not 0"),
    "frame rate that is none": ({"fps": float("nan")}, r"--fps must be above 0 and at most 1000, not nan"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_bad_options(name: str, good_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options, sentence = OPTIONS[name]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=sentence):
        prepare_with(good_folder, tmp_path / "out", **options)


def test_a_folder_that_is_something_else_is_not_overwritten(good_folder: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"precious exists and is not a prepared subject; choose another --out"):
        prepare_with(good_folder, precious)
    assert (precious / "thesis.tex").read_text() == "years of work"
    (precious / "thesis.tex").unlink()
    prepare_with(good_folder, precious)  # an empty folder is as good as none
    assert (precious / "manifest.json").is_file()


@pytest.mark.parametrize("also", ["thesis.tex", ".git"])
def test_a_folder_that_holds_something_else_too_is_not_overwritten(
    also: str, good_folder: Path, tmp_path: Path
) -> None:
    """A manifest.json belongs to many programs, and people put things into folders."""
    other, prepared = tmp_path / "other", tmp_path / "prepared"
    other.mkdir()
    (other / "manifest.json").write_text('{"name": "a page"}')
    (other / also).write_text("years of work")
    with pytest.raises(UserError, match=r"other exists and is not a prepared subject; choose another --out"):
        prepare_with(good_folder, other)
    prepare_with(good_folder, prepared)
    (prepared / also).write_text("years of work")
    with pytest.raises(UserError, match=f"prepared also holds {also}, which is no part of a prepared subject"):
        prepare_with(good_folder, prepared, max_left_out=0.04)
    assert (other / also).read_text() == (prepared / also).read_text() == "years of work"


def test_a_place_that_cannot_be_written(good_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        UserError, match=r"nothing can be written in .*file/sub \(Not a directory\); name another .* AVATAR_CACHE"
    ):
        prepare_with(good_folder, tmp_path / "file/sub/out")


def test_another_head_model_is_noticed_by_its_expressions(good_folder: Path, tmp_path: Path) -> None:
    small = write_head_model(tmp_path / "small", expressions=4)
    with pytest.raises(
        UserError, match="has 10 expression coefficients but the head model has 4 expression directions"
    ):
        prepare(Source(good_folder, tmp_path / "small"), small, out=tmp_path / "out", say=str)
