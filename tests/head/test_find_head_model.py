"""Head models as they are unpacked: in folders of folders, beside others, or not unpacked at all."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from tracked_folder import write_head_model

from avatar.errors import UserError
from avatar.files.pickles import load_pickle
from avatar.head.assets import load_head_assets
from avatar.head.find_head_model import find_model_file


@pytest.fixture
def model(tmp_path: Path) -> Path:
    write_head_model(tmp_path / "model")
    return tmp_path / "model"


@pytest.mark.parametrize("below", ["FLAME2023", "download/FLAME2023"])
def test_a_head_model_some_folders_down_is_found_and_it_is_said(below: str, model: Path, tmp_path: Path) -> None:
    (tmp_path / "flame" / below).parent.mkdir(parents=True)
    model.rename(tmp_path / "flame" / below)
    (tmp_path / "flame" / "__MACOSX").mkdir()
    (tmp_path / "flame" / "__MACOSX" / "._generic_model.pkl").write_bytes(b"")
    head = load_head_assets(tmp_path / "flame")
    assert head.notes == (f"the head model is {tmp_path / 'flame' / below / 'generic_model.pkl'}",)
    assert head.eyelid_dirs.any() and "lips" in head.regions  # what lies beside it is found too


def test_several_head_models_in_one_folder_are_said(model: Path) -> None:
    for name in ("female_model.pkl", "generic_model.npz", "FLAME_texture.npz"):
        (model / name).write_bytes(b"")
    head = load_head_assets(model)
    (note,) = head.notes
    assert "several head models" in note and "generic_model.pkl is used" in note
    assert "female_model.pkl" in note and "generic_model.npz" in note and "texture" not in note


def test_nothing_is_said_of_one_head_model_or_of_a_named_file(model: Path) -> None:
    assert load_head_assets(model).notes == ()
    (model / "other.npz").write_bytes(b"")
    assert load_head_assets(model / "generic_model.pkl").notes == ()


def test_several_that_could_be_it_are_named(model: Path, tmp_path: Path) -> None:
    (tmp_path / "two").mkdir()
    model.rename(tmp_path / "two" / "a")
    write_head_model(tmp_path / "two" / "b")
    with pytest.raises(UserError, match=r"several files that could be .*a/generic_model.pkl, b/generic_model.pkl"):
        find_model_file(tmp_path / "two")


@pytest.mark.parametrize("named", [True, False])
def test_a_suffix_may_be_written_large(named: bool, model: Path) -> None:
    pickled, arrays = model / "generic_model.pkl", model / "MODEL.NPZ"
    wanted = load_head_assets(model).fingerprint
    with arrays.open("wb") as file:
        np.savez(file, **load_pickle(pickled))
    pickled.unlink()
    assert load_head_assets(arrays if named else model).fingerprint == wanted


@pytest.mark.parametrize("name", ["FLAME2023.zip", "FLAME2023.pkl", "FLAME2023"])
def test_the_download_as_it_came_has_to_be_unpacked(name: str, model: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.write(model / "generic_model.pkl", "FLAME2023/generic_model.pkl")
    with pytest.raises(UserError, match=f"{name} is an archive; unpack it"):
        load_head_assets(tmp_path / name)


def test_a_folder_with_the_archive_alone_says_so(tmp_path: Path) -> None:
    (tmp_path / "flame").mkdir()
    (tmp_path / "flame" / "FLAME2023.zip").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"no head model, only the archive FLAME2023.zip; unpack it there"):
        load_head_assets(tmp_path / "flame")
