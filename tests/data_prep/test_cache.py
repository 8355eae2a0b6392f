"""A subject is prepared once, and again when an input changes; what was there before stays until then."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from preparing import edit, prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.manifest import read_manifest
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.pipeline import cached_tracking as caching
from data_prep.prepare import write_prepared
from data_prep.prepare.prepare import prepare


def test_prepared_once_and_again_when_an_input_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    head_path = folder / "head_model"
    head = load_head_assets(head_path)

    def run(test_frames: int | None = None) -> tuple[Path, str, bool]:
        said: list[str] = []
        prepared = prepare(Source(folder, head_path), head, test_frames=test_frames, say=said.append)
        assert prepared.is_relative_to(tmp_path / "cache" / "subjects")
        return prepared, read_manifest(prepared).data_hash, said == [f"using the prepared subject {prepared}"]

    first, first_hash, reused = run()
    assert not reused
    assert run() == (first, first_hash, True)

    image = folder / "imgs" / "00003.jpg"
    os.utime(image, ns=(1, 1))  # looked at again, and found to be the same
    assert run() == (first, first_hash, False)
    assert run() == (first, first_hash, True)

    shutil.copy(folder / "imgs" / "00004.jpg", image)
    _, changed_hash, reused = run()
    assert not reused and changed_hash != first_hash

    other, _, reused = run(test_frames=2)
    assert not reused and other != first and len(read_manifest(other).test) == 2

    assert sorted(p.name for p in (tmp_path / "cache" / "subjects").iterdir()) == sorted([first.name, other.name])


@pytest.mark.parametrize("name", ["a line\nand another ", "not UTF-8 \udcff"])
def test_pictures_of_any_name_are_prepared_once(name: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=10, mouth_masks=False)
    for path in [*(folder / "imgs").iterdir(), *(folder / "alpha").iterdir(), *(folder / "parsing").iterdir()]:
        path.rename(path.with_name(name + path.name))
    subject, _ = prepare_folder(folder, tmp_path / "prepared", frame_offset=1)
    assert prepare_folder(folder, tmp_path / "prepared", frame_offset=1)[1] == [
        f"using the prepared subject {tmp_path / 'prepared'}"
    ]
    assert subject.frame(0, None).mouth_mask.any()


def test_another_head_model_prepares_again(tmp_path: Path) -> None:
    """Also in a place that was chosen, which the key of the cache does not name."""
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    head = load_head_assets(folder / "head_model")

    def run(which: HeadAssets) -> str:
        prepared = prepare(Source(folder, folder / "head_model"), which, out=tmp_path / "out", say=lambda _: None)
        return read_manifest(prepared).head_fingerprint

    assert run(head) == head.fingerprint
    assert run(replace(head, fingerprint="f" * 64)) == "f" * 64
    assert run(head) == head.fingerprint


def test_prepared_again_when_the_head_model_has_moved(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=6)
    head = load_head_assets(folder / "head_model")
    shutil.copytree(folder / "head_model", tmp_path / "moved")
    for place in (folder / "head_model", tmp_path / "moved"):
        prepare(Source(folder, place, frame_offset=1), head, out=tmp_path / "out", say=lambda _: None)
        assert read_manifest(tmp_path / "out").head_path == str(place)


def test_a_failed_preparation_keeps_the_old_one(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    subject, _ = prepare_folder(folder, tmp_path / "out")
    shutil.rmtree(folder / "imgs")
    with pytest.raises(UserError, match="has no frames"):
        prepare_folder(folder, tmp_path / "out")
    assert Subject.open(tmp_path / "out").data_hash == subject.data_hash


@pytest.mark.parametrize("offsets", [(1, 1), (0, 1)])
def test_several_at_once_all_succeed(offsets: tuple[int, int], tmp_path: Path) -> None:
    """As trainings that are started together on a new subject do; one's folder stays, whole."""
    folder = write_tracked_folder(tmp_path / "subject", frames=12, mouth_masks=False)
    head_path = folder / "head_model"
    head = load_head_assets(head_path)

    def run(offset: int) -> Path:
        return prepare(Source(folder, head_path, frame_offset=offset), head, out=tmp_path / "out", say=str)

    with ThreadPoolExecutor(max_workers=4) as pool:
        assert list(pool.map(run, offsets * 6)) == [tmp_path / "out"] * 12
    subject = Subject.open(tmp_path / "out")
    assert subject.frame(len(subject) - 1).mouth_mask.max() > 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "subject"]


def test_a_folder_that_is_moved_away_while_it_is_read_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by another process that prepares the same subject."""

    def rglob(self: Path, pattern: str) -> Iterator[Path]:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self / "mouth"))

    prepared, _ = prepare_folder(write_tracked_folder(tmp_path / "subject", frames=12), tmp_path / "out")
    inputs, said = prepared.manifest.input_hash, list[str]()
    assert write_prepared.is_current(tmp_path / "out", inputs, is_chosen=True)
    monkeypatch.setattr(Path, "rglob", rglob)
    assert not write_prepared.is_current(tmp_path / "out", inputs, is_chosen=True, say=said.append)
    assert "cannot be listed" in said[0]


def test_nothing_is_left_over_where_several_take_one_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write_prepared, "is_current", lambda *_, **__: False)

    def write(number: int) -> None:
        (building := tmp_path / f"building{number}").mkdir()
        (building / "whole").touch()
        write_prepared._replace(tmp_path / "out", building, "")
        shutil.rmtree(building, ignore_errors=True)

    with ThreadPoolExecutor(max_workers=4) as pool:
        list(pool.map(write, range(400)))
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["out", "out/whole"]


def test_the_data_hash_is_of_the_tracking_and_does_not_depend_on_the_place(tmp_path: Path) -> None:
    a = write_tracked_folder(tmp_path / "a" / "one", frames=12)
    shutil.copytree(a, tmp_path / "b" / "two")
    first, _ = prepare_folder(a, tmp_path / "out1")
    second, _ = prepare_folder(tmp_path / "b" / "two", tmp_path / "out2")
    assert first.data_hash == second.data_hash and first.manifest.input_hash != second.manifest.input_hash
    edit(a / "checkpoint" / "00003.frame", "flame", eyelids=np.full((1, 2), 0.25, np.float32))
    assert prepare_folder(a, tmp_path / "out3")[0].data_hash != first.data_hash


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def place(path: Path, content: bytes) -> int:
    return path.read_bytes().index(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "tracks cut short": lambda p: cut(p / "tracks.safetensors"),
    "a flipped bit in the tracks": lambda p: flip(p / "tracks.safetensors", -5),
    "tracks missing": lambda p: (p / "tracks.safetensors").unlink(),
    "a flipped bit in the manifest": lambda p: flip(
        p / "manifest.json", p.joinpath("manifest.json").read_bytes().find(b"179.2")
    ),
    "manifest cut short": lambda p: cut(p / "manifest.json"),
    "a flipped bit in a mask": lambda p: flip(p / "mouth" / "00003.png", -20),
    "a mask missing": lambda p: (p / "mouth" / "00003.png").unlink(),
    "its hashes cut short": lambda p: (p / "contents.sha256").write_text(""),
    "its hashes missing": lambda p: (p / "contents.sha256").unlink(),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_prepared_subject_is_made_again_and_it_is_said(name: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=6, mouth_masks=False)
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert not any("is damaged" in line for line in said)
    before = {path: path.read_bytes() for path in sorted((tmp_path / "out").rglob("*")) if path.is_file()}
    DAMAGES[name](tmp_path / "out")
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert "is damaged" in said[0] and "made again" in said[0], said
    after = {path: path.read_bytes() for path in sorted((tmp_path / "out").rglob("*")) if path.is_file()}
    assert after == before
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert said == [f"using the prepared subject {tmp_path / 'out'}"]


NAMES = {
    "255 characters": "x" * 255,
    "255 bytes of two each": "\u00e9" * 127,
    "not UTF-8": os.fsdecode(b"Zo\xeb"),
    "a line break": "a\nb",
    "blanks": "   ",
}


@pytest.mark.parametrize("name", NAMES)
def test_folders_of_any_name_are_prepared(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    folder = write_tracked_folder(tmp_path / "subject", frames=6).rename(tmp_path / NAMES[name])
    head = load_head_assets(folder / "head_model")
    source = Source(folder, folder / "head_model", frame_offset=1)
    prepared = prepare(source, head, say=lambda _: None)
    assert len(prepared.name.encode()) < 200 and prepared.name.isprintable()
    subject = Subject.open(prepared)
    assert subject.frame(2).image.shape == (64, 64, 3) and subject.name.isprintable()
    said: list[str] = []
    assert prepare(source, head, say=said.append) == prepared and len(said) == 1


def test_frames_whose_names_are_not_utf_8_are_prepared(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=6)
    for path in sorted((folder / "imgs").iterdir()):
        path.rename(path.with_name(os.fsdecode(b"Zo\xeb_") + path.name))
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert subject.frame(2).image.shape == (64, 64, 3)


def test_a_place_with_the_longest_name_can_be_chosen(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=6)
    subject, _ = prepare_folder(folder, tmp_path / ("x" * 255), frame_offset=1)
    assert len(subject) == 6


def test_a_damaged_tracking_in_the_cache_is_made_again_and_it_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    video = tmp_path / ("x" * 250 + ".mp4")
    video.write_bytes(b"a video")
    head = write_tracked_folder(tmp_path / "subject", frames=2) / "head_model"
    made: list[Path] = []

    def fake_track(video: Path, out: Path, *_: object, seal: Callable[[Path], object], **__: object) -> None:
        (out / "frames").mkdir(parents=True)
        (out / "frames" / "00000.jpg").write_bytes(b"picture")
        (out / "tracking.json").write_text("{}")
        seal(out)
        made.append(out)

    monkeypatch.setattr(caching, "track", fake_track)
    monkeypatch.setattr(caching, "open_footage", lambda path: SimpleNamespace(content_hash="ab"))
    folder = caching.cached_tracking(video, head)
    assert caching.cached_tracking(video, head) == folder and made == [folder]
    flip(folder / "frames" / "00000.jpg", 2)
    capsys.readouterr()
    assert caching.cached_tracking(video, head) == folder and made == [folder, folder]
    assert "frames/00000.jpg is not what was written; it is made again" in capsys.readouterr().out
    assert caching.cached_tracking(video, head) == folder and made == [folder, folder]
