"""Folders that are no subjects: each is called what it is, and what to give instead is named, before anything is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tracked_folder import write_head_model, write_tracked_folder

from avatar.cli import main
from avatar.errors import UserError
from data_prep.prepare.wrong_inputs import check_folder


def run(folder: Path) -> None:
    (folder / "run.json").write_text(json.dumps({"source": {"folder": "/videos/me"}}))


def damaged_run(folder: Path) -> None:
    (folder / "run.json").write_text("{")
    (folder / "checkpoints").mkdir()


def prepared(folder: Path) -> None:
    (folder / "manifest.json").write_text(json.dumps({"source": "/videos/me"}))
    (folder / "tracks.safetensors").write_bytes(b"")


def demo(folder: Path) -> None:
    for name in ("actor", "driver"):
        write_tracked_folder(folder / name, frames=1)
    (folder / "run").mkdir()
    run(folder / "run")


def one_below(folder: Path) -> None:
    write_tracked_folder(folder / "me", frames=1)


def many_below(folder: Path) -> None:
    for n in range(6):
        (folder / f"p{n}" / "imgs").mkdir(parents=True)


def pictures(folder: Path) -> None:
    assert cv2.imwrite(str(folder / "00001.png"), np.zeros((8, 8, 3), np.uint8))


CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a run": (run, r"is a run of avatar train; give the folder that it was trained on, /videos/me$"),
    "a damaged run": (damaged_run, r"is a run of avatar train; give the folder that it was trained on$"),
    "a prepared subject": (prepared, r"is a prepared subject; give the tracked folder .* from, /videos/me$"),
    "what make demo left": (demo, r"it holds actor/ and driver/; give one of them$"),
    "a folder around it": (one_below, r"it holds me/; give it$"),
    "many people": (many_below, r"it holds p0/, p1/, p2/, p3/ and 2 more; give one of them$"),
    "pictures": (pictures, r"holds pictures and no tracking; avatar track .* makes a tracked folder of them$"),
    "a head model": (write_head_model, r"is a head model; give the tracked folder, and this one with --head$"),
    "nothing": (lambda folder: None, r"is empty; docs/data.md says what belongs"),
    "something else": (lambda f: (f / "x.txt").write_text(""), r"holds nothing that belongs to a tracked folder"),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_no_subject_is_called_what_it_is(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make, sentence = CASES[name]
    folder = tmp_path / "folder"
    folder.mkdir()
    make(folder)
    with pytest.raises(UserError, match=sentence):
        check_folder(folder)
    monkeypatch.chdir(tmp_path)
    assert main(["check", str(folder), "--json"]) == 2
    said = capsys.readouterr()
    (finding,) = json.loads(said.out)["findings"]
    assert finding["check"] == "layout" and "0it" not in said.err and "frame-offset" not in said.out
    if name != "pictures":  # which are tracked first
        for words in (["train", str(folder)], ["train", str(folder), "--out", str(folder / "run2")]):
            assert main(words) == 1
            # A run's folder would be resumed.
            expected = f"{folder} is a run: add --resume" if name.endswith("run") else finding["problem"]
            assert expected in capsys.readouterr().err


@pytest.mark.parametrize("missing", ["imgs", "checkpoint", "parsing", "head_model"])
def test_a_subject_that_lacks_a_part_is_a_subject(missing: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=1)
    (folder / missing).rename(tmp_path / "moved")
    check_folder(folder)
