"""The folder that refinement writes of several cameras: read back with its rig, both trackings, any choice of cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from camera_rig_folder import edited, write_listings, write_single, write_union

from avatar.data.refinement_history import Refinement, Round
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.avatar_track import read_info
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.refined_folder import REFINEMENT_FILE, frame_numbers, write_folder
from data_prep.prepare.open_subject import open_subject


def opened(folder: Path, head: Path, **options: Any) -> Subject:
    return open_subject(Source(folder, head, **options), None, lambda _: None)[0]


def better(subject: Subject) -> dict[str, torch.Tensor]:
    tracks = {name: value.clone() for name, value in subject.recording.tracks.items()}
    tracks["t"] += torch.tensor([0.0005, 0.0, -0.0005])
    tracks["expression"] *= 0.9
    return tracks


def history(subject: Subject) -> Refinement:
    numbers = frame_numbers(subject)
    return Refinement("VHAP", (Round("/runs/first", 600, "ab" * 32, tuple(numbers[i] for i in subject.split.train)),))


def written_of(folder: Path, target: Path) -> tuple[Subject, Path]:
    subject = opened(folder, folder.parent / "head_model")
    write_folder(target, subject, better(subject), history(subject), {})
    return subject, target


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> tuple[Subject, Path]:
    root = tmp_path_factory.mktemp("single")
    return written_of(write_single(root), root / "refined")


@pytest.fixture(scope="module")
def union(tmp_path_factory: pytest.TempPathFactory) -> tuple[Subject, Path]:
    root = tmp_path_factory.mktemp("union")
    return written_of(write_union(root), root / "refined")


def head_of(written: Path) -> Path:
    return written.parent / "head_model"


@pytest.mark.parametrize("layout", ["single", "union"])
def test_a_refined_rig_is_read_back_with_both_trackings(layout: str, request: pytest.FixtureRequest) -> None:
    subject, written = request.getfixturevalue(layout)
    again = opened(written, head_of(written))
    assert again.recording.rig == subject.recording.rig
    assert again.split == subject.split and again.manifest.refinement == history(subject)
    assert again.given is not None
    for name, value in better(subject).items():
        assert torch.allclose(again.recording.tracks[name], value, atol=1e-6), name
        assert torch.allclose(again.given.tracks[name], subject.recording.tracks[name], atol=1e-6), name
    times = [record.tracking for record in subject.manifest.frames]
    assert [record.tracking for record in again.manifest.frames] == times
    for index in (0, len(subject) - 1):
        ours, theirs = again.frame(index), subject.frame(index)
        for name in ("image", "alpha", "head_mask", "mouth_mask"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


def test_times_of_validation_alone_are_not_trained_on_after_refinement(tmp_path: Path) -> None:
    folder = edited(write_single(tmp_path), tmp_path / "copy", lambda _: None)
    every = [entry for file in folder.glob("*.json") for entry in json.loads(file.read_text())["frames"]]
    parts = {"train": (0, 1, 2), "val": (3,), "test": (4, 5)}
    write_listings(folder, {part: [e for e in every if e["timestep_index"] in own] for part, own in parts.items()})
    subject, written = written_of(folder, tmp_path / "refined")
    again = opened(written, tmp_path / "head_model")
    assert again.split == subject.split
    assert {again.recording.time(i) for i in again.split.train} == {0, 1, 2}


def test_a_second_round_of_a_rig_keeps_numbers_and_what_the_tracker_left(
    single: tuple[Subject, Path], tmp_path: Path
) -> None:
    subject, written = single
    first = opened(written, head_of(written))
    rounds = (*history(subject).rounds, *history(first).rounds)
    write_folder(tmp_path / "twice", first, better(first), replace(history(subject), rounds=rounds), {})
    twice = opened(tmp_path / "twice", head_of(written))
    assert frame_numbers(twice) == frame_numbers(first) == frame_numbers(subject) == list(range(18))
    assert twice.given is not None
    assert torch.allclose(twice.given.tracks["t"], subject.recording.tracks["t"], atol=1e-6)


def test_cameras_of_a_refined_rig_are_chosen_by_name(single: tuple[Subject, Path]) -> None:
    subject, written = single
    two = opened(written, head_of(written), cameras="08,12")
    assert [camera.name for camera in two.recording.cameras] == ["08", "12"] and len(two) == 12
    assert frame_numbers(two) == [i for i in range(18) if subject.recording.view(i) != 1]
    front = opened(written, head_of(written), cameras="front")
    assert [camera.name for camera in front.recording.cameras] == ["08"]
    for index in range(len(two)):
        original = frame_numbers(two)[index]
        moved = replace(subject.recording, tracks=better(subject))
        for name in ("R_cam_world", "t_cam_world"):
            ours, theirs = (getattr(one.camera(i), name) for one, i in ((two.recording, index), (moved, original)))
            torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=0)
    with pytest.raises(UserError, match="no camera '99'"):
        opened(written, head_of(written), cameras="99")


def test_other_test_cameras_of_a_refined_rig_show_which_pictures_had_been_trained_on(
    single: tuple[Subject, Path],
) -> None:
    _, written = single
    again, _ = open_subject(Source(written, head_of(written)), None, lambda _: None, test_cameras="07")
    numbers = [again.manifest.number(index) for index in again.split.test]
    assert again.manifest.refinement is not None
    trained = again.manifest.refinement.trained_on(numbers)
    assert [again.recording.names[number] for number in trained] and len(trained) == 4  # of 07 at the times of training


def test_a_picture_that_is_gone_from_a_refined_rig_is_left_out(single: tuple[Subject, Path], tmp_path: Path) -> None:
    subject, written = single
    shutil.copytree(written, tmp_path / "copy")
    for kind in ("frames", "matte", "head", "mouth"):
        for path in (tmp_path / "copy" / kind).glob("00007.*"):
            path.unlink()
    again = opened(tmp_path / "copy", head_of(written))
    assert len(again) == len(subject) - 1
    assert frame_numbers(again) == [number for number in range(18) if number != 7]


def test_the_check_takes_a_refined_rig_like_any_folder(single: tuple[Subject, Path]) -> None:
    from avatar.head.assets import load_head_assets

    _, written = single
    outcome = check_tracked_folder(written, lambda: load_head_assets(head_of(written)))
    assert not [finding for finding in outcome.findings if finding.severity == "error"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda raw: raw["rig"].pop("cameras"), "'cameras'"),
        (lambda raw: raw["rig"].update(numbers=[0] * 18), "do not increase"),
        (lambda raw: raw["rig"].update(numbers=list(range(17))), "times is not a list of 17"),
        (lambda raw: raw["rig"].update(views=[7] * 18), "views holds"),
        (lambda raw: raw["rig"].update(views=[0.0] * 18), "views holds"),
        (lambda raw: raw["rig"]["cameras"][0].update(R=[1] * 9), "not a rotation"),
        (lambda raw: raw["rig"]["cameras"][1].update(intrinsics=[90.0, -90.0, 24.0, 24.0]), "not positive"),
        (lambda raw: raw["rig"]["cameras"][1].update(width=2**16), f"image size of {2**16}x.* is impossible"),
        (lambda raw: raw.update(rig=3), "damaged"),
        (lambda raw: raw["rig"].update(times=list(range(18))), "fewer than its pictures"),
        (lambda raw: raw["rig"].update(numbers=list(range(50, 68))), "holds no picture"),
        (lambda raw: raw["rig"].update(numbers=[*range(17), "x"]), r"numbers\[17\] is not a whole number"),
    ],
)
def test_a_damaged_rig_is_a_sentence(
    single: tuple[Subject, Path], tmp_path: Path, change: Callable[[dict[str, Any]], object], said: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(single[1], copy)
    raw = json.loads((copy / REFINEMENT_FILE).read_text())
    change(raw)
    (copy / REFINEMENT_FILE).write_text(json.dumps(raw))
    with pytest.raises(UserError, match=said):
        open_tracked_folder(copy)


def test_tracking_of_a_refined_rig_has_a_row_for_each_time(union: tuple[Subject, Path]) -> None:
    subject, written = union
    with np.load(written / "tracking.npz") as arrays:
        assert arrays["number"].tolist() == sorted({record.tracking for record in subject.manifest.frames})
        assert len(arrays["number"]) == 10


def test_what_was_left_out_has_no_number_where_names_end_in_something_else(tmp_path: Path) -> None:
    """Here in the camera's."""
    folder = write_single(tmp_path)
    (folder / "images" / "00001_12.png").unlink()
    subject = opened(folder, tmp_path / "head_model", cameras="12", max_left_out=0.2)
    write_folder(tmp_path / "refined", subject, better(subject), history(subject), {})
    assert list(subject.manifest.left_out) == ["00001_12"] and frame_numbers(subject) == [0, 2, 3, 4, 5]
    assert read_info(tmp_path / "refined").left_out == {}
