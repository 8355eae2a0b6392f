"""A subject is prepared once, and again when an input changes; what was there before stays until then."""

from __future__ import annotations

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from preparing import prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.manifest import read_manifest
from avatar.data.source import Source
from avatar.data.split import SplitSizes
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets
from data_prep.prepare import prepare


def test_prepared_once_and_again_when_an_input_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    head_path = folder / "head_model"
    head = load_head_assets(head_path)

    def run(split: SplitSizes | None = None) -> tuple[Path, str, bool]:
        said: list[str] = []
        prepared = prepare(Source(folder, head_path), head, split=split, say=said.append)
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

    other, _, reused = run(split=SplitSizes(test=2))
    assert not reused and other != first and len(read_manifest(other).test) == 2

    (first / "manifest.json").write_text("{")
    assert not run()[2] and run()[2]
    (first / "tracks.safetensors").unlink()
    assert not run()[2] and run()[2]
    assert sorted(p.name for p in (tmp_path / "cache" / "subjects").iterdir()) == sorted([first.name, other.name])


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


def test_the_data_hash_does_not_depend_on_the_place(tmp_path: Path) -> None:
    a = write_tracked_folder(tmp_path / "a" / "one", frames=12)
    shutil.copytree(a, tmp_path / "b" / "two")
    first, _ = prepare_folder(a, tmp_path / "out1")
    second, _ = prepare_folder(tmp_path / "b" / "two", tmp_path / "out2")
    assert first.data_hash == second.data_hash and first.manifest.input_hash != second.manifest.input_hash
