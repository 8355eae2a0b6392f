"""The folder that avatar track writes is read as it is: the same subject as from the folder that it was made of."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from as_tracked import write_as_tracked
from tracked_folder import write_tracked_folder

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.folder import check_tracked_folder
from data_prep.formats import avatar_track
from data_prep.formats.avatar_track import read_info, write_tracking
from data_prep.prepare.open_subject import find_head
from data_prep.prepare.prepare import prepare

FRAMES, SIZE = 24, 64


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("original") / "someone", FRAMES, SIZE, suffix=".png")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """The original's content in this format, without frames 5 and 6."""
    return write_as_tracked(original, tmp_path / "someone")


def open_prepared(folder: Path, head: Path, out: Path, **options) -> tuple[Subject, list[str]]:
    said: list[str] = []
    prepared = prepare(Source(folder, head, **options), load_head_assets(head), out=out, say=said.append)
    return Subject.open(prepared), said


def test_the_same_subject(original: Path, folder: Path, tmp_path: Path) -> None:
    head = original / "head_model"
    mine, said = open_prepared(folder, head, tmp_path / "mine")
    theirs, _ = open_prepared(original, head, tmp_path / "theirs")
    assert said[0] == "format: avatar-track" and mine.manifest.frame_offset == 0
    assert said[1].startswith("images and tracking are paired by tracking.json: head overlap")
    assert any("the focal length is assumed: a lens of 28 mm equivalent: give --focal" in line for line in said)
    assert len(mine) == FRAMES - 2 and mine.recording.fps == 29.97
    at = [n for n in range(FRAMES) if n not in (5, 6)]
    for name in ("expression", "jaw", "eyes", "eyelids", "neck", "R", "t"):
        torch.testing.assert_close(mine.recording.tracks[name], theirs.recording.tracks[name][at], atol=1e-6, rtol=0)
    for index, number in ((0, 0), (10, 12)):
        a, b = mine.frame(index), theirs.frame(number)
        for part in ("image", "alpha", "head_mask", "mouth_mask"):
            assert torch.equal(getattr(a, part), getattr(b, part)), part


def test_the_head_model_is_remembered(original: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_head(folder) == original / "head_model"
    assert find_head(folder, Path("other")) == Path("other")
    info = dataclasses.replace(read_info(folder), head_path="/nowhere/head")
    write_tracking(folder, info, tracks_of(folder, original))
    with pytest.raises(UserError, match="no head model for"):
        find_head(folder)


def tracks_of(folder: Path, original: Path) -> dict:
    head = load_head_assets(original / "head_model")
    return avatar_track.open_folder(folder).read(head, (SIZE, SIZE), lambda problem: None).frames


def test_another_head_model_is_refused(folder: Path, tmp_path: Path) -> None:
    other = write_tracked_folder(tmp_path / "other", 4, SIZE, expressions=7) / "head_model"
    with pytest.raises(UserError, match="was tracked with another head model .* give .*head_model with --head"):
        open_prepared(folder, other, tmp_path / "out")


def test_check_reads_it(original: Path, folder: Path) -> None:
    outcome = check_tracked_folder(folder, lambda: load_head_assets(original / "head_model"))
    assert outcome.status == 0 and outcome.to_dict()["facts"]["format"] == "avatar-track"
    assert outcome.to_dict()["facts"]["frame offset"] == 0


def test_what_is_written_is_read(folder: Path, original: Path) -> None:
    before, info = tracks_of(folder, original), read_info(folder)
    write_tracking(folder, info, before)
    after = tracks_of(folder, original)
    assert read_info(folder) == info and info.left_out == {5: "no face was found", 6: "no face was found"}
    assert before.keys() == after.keys()
    for number, track in before.items():
        np.testing.assert_allclose(track.moving_values(), after[number].moving_values(), atol=1e-6)


LISTING = {
    "no JSON": (b"{", "cannot be read as JSON"),
    "another thing": (b"[]", "is not the listing of a folder that avatar track wrote"),
    "another version": ({"version": 99}, "has version 99, this program reads 1; track the video again"),
    "no rate": ({"fps": None}, "is damaged"),
    "a rate of nothing": ({"fps": 0}, "its camera or its rate cannot be"),
    "a camera of three": ({"intrinsics": [1, 1, 1]}, "intrinsics has 3 values, not 4"),
    "a camera at infinity": ({"intrinsics": [float("inf"), 1, 1, 1]}, "intrinsics[0] is not a finite number"),
    "a size of nothing": ({"width": 0}, "its camera or its rate cannot be"),
    "left out what": ({"left_out": {"a": "b"}}, "is damaged (left_out has the key 'a', not a number)"),
}


@pytest.mark.parametrize("fault", LISTING)
def test_damaged_listings(folder: Path, fault: str) -> None:
    change, sentence = LISTING[fault]
    path = folder / "tracking.json"
    content = change if isinstance(change, bytes) else json.dumps(json.loads(path.read_bytes()) | change).encode()
    path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        avatar_track.open_folder(folder)
    assert sentence in str(caught.value) and "tracking.json" in str(caught.value)


ARRAYS = {
    "no numbers": ({"number": None}, "no list of frame numbers"),
    "numbers that fall": ({"number": np.arange(22)[::-1]}, "its frame numbers do not increase"),
    "fractions": ({"number": np.arange(22) / 2}, "no list of frame numbers"),
    "a jaw of five": ({"jaw": np.zeros((22, 5), np.float32)}, "jaw is missing or of the wrong shape"),
    "one frame less": ({"t": np.zeros((21, 3), np.float32)}, "t is missing or of the wrong shape"),
    "no identity": ({"shape": None}, "shape is missing or of the wrong shape"),
}


@pytest.mark.parametrize("fault", ARRAYS)
def test_damaged_tracks(folder: Path, fault: str) -> None:
    change, sentence = ARRAYS[fault]
    arrays = dict(np.load(folder / "tracking.npz")) | change
    np.savez(folder / "tracking.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(UserError) as caught:
        avatar_track.open_folder(folder)
    assert sentence in str(caught.value) and "tracking.npz" in str(caught.value)


def test_single_frames_that_are_damaged_are_left_out(folder: Path, original: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(folder / "tracking.npz"))
    arrays["expression"][3, 2] = np.nan
    np.savez(folder / "tracking.npz", **arrays)
    subject, said = open_prepared(folder, original / "head_model", tmp_path / "out", max_left_out=0.1)
    assert len(subject) == FRAMES - 3
    assert any("left out 1 of 22 frames: 00003 (expression is not finite (1 of 10 values))" in line for line in said)


def test_an_option_that_does_not_belong(folder: Path, original: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a folder of avatar track holds its own tracking"):
        open_prepared(folder, original / "head_model", tmp_path / "out", tracking=folder)
    with pytest.raises(UserError, match="--frame-offset 1: tracking.json itself says"):
        open_prepared(folder, original / "head_model", tmp_path / "out", frame_offset=1)
