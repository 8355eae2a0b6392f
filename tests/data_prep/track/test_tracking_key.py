"""A cached tracking is of everything that it was made from: what is added or changed makes another."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from tracked_folder import write_head_model

from avatar.files.third_party import FACE_LANDMARKER, FOLDER_VARIABLE, SELFIE_MULTICLASS
from avatar.head.assets import load_head_assets
from avatar.pipeline import cached_tracking as caching
from data_prep.track import cache_key
from data_prep.track.cache_key import head_inputs, tracking_key
from data_prep.track.faces.embedding import OFFICIAL_FILE
from data_prep.track.footage.source import Box, Span
from data_prep.track.stage_folder import StageFolder
from data_prep.track.tracking_stages import Choices, TrackingStages


@pytest.fixture
def head(tmp_path: Path) -> Path:
    write_head_model(tmp_path / "head")
    return tmp_path / "head"


def footage(content: str = "ab") -> Any:
    return SimpleNamespace(content_hash=content)


def key(head: Path, choices: Choices | None = None, video: str = "ab") -> str:
    return tracking_key(footage(video), (choices or Choices()).to_json(), head, load_head_assets(head))


def add_names(head: Path) -> None:
    (head / "expression_names.json").write_text(json.dumps(["smile"]))


def add_embedding(head: Path) -> None:
    np.savez(head / OFFICIAL_FILE, lmk_face_idx=[0], lmk_b_coords=[[1.0, 0, 0]], landmark_indices=[0])


def change_head(head: Path) -> None:
    write_head_model(head, mouth_opening=True)


ADDED: dict[str, Callable[[Path], object]] = {
    "names of the expressions": add_names,
    "the landmark embedding": add_embedding,
    "another head model": change_head,
}


@pytest.mark.parametrize("name", ADDED)
def test_what_lies_beside_the_head_model_is_in_the_key_of_all_and_of_the_fit(name: str, head: Path) -> None:
    before, of_fit = key(head), head_inputs(head, load_head_assets(head))
    ADDED[name](head)
    assert key(head) != before and head_inputs(head, load_head_assets(head)) != of_fit


def test_an_embedding_that_changes_is_another(head: Path) -> None:
    add_embedding(head)
    before = key(head)
    np.savez(head / OFFICIAL_FILE, lmk_face_idx=[1], lmk_b_coords=[[1.0, 0, 0]], landmark_indices=[0])
    assert key(head) != before


def test_a_head_model_given_by_its_file_has_the_names_beside_it(head: Path) -> None:
    add_names(head)
    add_embedding(head)
    assert key(head / "generic_model.pkl") == key(head)


def test_a_better_matte_network_makes_another(head: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "models"))
    before = key(head)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / SELFIE_MULTICLASS.name).write_bytes(b"")
    assert key(head) != before


@pytest.mark.parametrize(
    "choices",
    [Choices(crop=Box(0, 0, 64, 64)), Choices(crop="none"), Choices(size=99), Choices(span=Span(1.0)),
     Choices(span=Span(0.0, 1.0)), Choices(focal=500.0), Choices(field_of_view=40.0), Choices(rotate=0),
     Choices(rotate=90)],
)  # fmt: skip
def test_every_choice_makes_another(choices: Choices, head: Path) -> None:
    assert key(head, choices) != key(head)


def test_another_video_landmarker_or_version_makes_another(head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = key(head)
    assert key(head, video="cd") != before
    with monkeypatch.context() as patch:
        patch.setattr(cache_key, "FACE_LANDMARKER", FACE_LANDMARKER._replace(sha256="0"))
        assert key(head) != before
    monkeypatch.setattr(cache_key, "STAGES_VERSION", 0)
    assert key(head) != before


def test_every_option_of_a_tracking_is_in_its_key(head: Path) -> None:
    """Whatever is added to the choices."""
    told = Choices().to_json()
    assert told.keys() == {field.name for field in fields(Choices)}


def test_a_landmark_that_lies_elsewhere_makes_another(head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no embedding lies beside the head model, its recipe counts."""
    before = key(head)
    monkeypatch.setattr(cache_key, "RECIPE", 0)
    assert key(head) != before


def test_a_matte_that_changes_makes_another(head: Path, tmp_path: Path) -> None:
    (tmp_path / "mattes").mkdir()
    keys = set()
    for value in (255, 255, 200):
        cv2.imwrite(str(tmp_path / "mattes" / "0.png"), np.full((64, 64), value, np.uint8))
        keys.add(key(head, Choices(matte=tmp_path / "mattes")))
    (tmp_path / "mattes" / "1.png").write_bytes((tmp_path / "mattes" / "0.png").read_bytes())
    keys.add(key(head, Choices(matte=tmp_path / "mattes")))
    assert len(keys) == 3


@pytest.mark.parametrize("name", ["masks.npz", "l_eyelid.npy"])
def test_another_file_of_the_head_model_makes_another(name: str, head: Path) -> None:
    before = key(head)
    path = head / name
    if name == "masks.npz":
        (head / "FLAME_masks.pkl").unlink()
        np.savez(path, lips=np.arange(3))
    else:
        np.save(path, np.load(path) + 0.001)
    assert key(head) != before


def test_user_mattes_make_another(head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_prep.track.tracking_stages.open_footage", lambda path: footage(path.name))
    keys = {key(head), key(head, Choices(matte=Path("a"))), key(head, Choices(matte=Path("b")))}
    assert len(keys) == 3


def test_a_file_that_was_added_has_the_video_tracked_again(
    head: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the program's own advice has it: put expression_names.json beside the model."""
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(caching, "open_footage", lambda _: footage())
    monkeypatch.setattr(caching, "track", lambda video, out, *_, seal, **__: (out.mkdir(parents=True), seal(out)))
    first = caching.cached_tracking(tmp_path / "me.mp4", head)
    add_names(head)
    assert caching.cached_tracking(tmp_path / "me.mp4", head) != first


def test_the_fit_of_a_folder_that_is_not_finished_is_made_again_too(head: Path, tmp_path: Path) -> None:
    """What an interruption left is of the head model as it was."""
    asked: list[dict[str, Any]] = []

    class Asked(StageFolder):
        def run(self, name: str, inputs: Any, make: Any) -> Any:
            asked.append(dict(inputs))
            raise StopIteration

    for added in (lambda _: None, add_names, add_embedding):
        added(head)
        work = TrackingStages(
            Asked(tmp_path), footage(), Choices(), load_head_assets(head), lambda items, total, title: items
        )
        landmarks: Any = SimpleNamespace(detected=np.ones(3, bool))
        with pytest.raises(StopIteration):
            work.fit(landmarks, (1.0, 1.0, 0.0, 0.0), head, [])
    assert len({json.dumps(values, sort_keys=True) for values in asked}) == 3


def test_the_same_inputs_have_the_same_key_wherever_they_lie(head: Path, tmp_path: Path) -> None:
    add_names(head)
    shutil.copytree(head, tmp_path / "elsewhere")
    assert key(tmp_path / "elsewhere") == key(head)
