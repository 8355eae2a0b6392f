"""Folders with several cameras: pictures, poses, times and what is held out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from camera_rig_folder import (
    AZIMUTHS,
    CENTRE,
    SEQUENCES,
    edited,
    from_front,
    lens,
    opened,
    write_listings,
    write_single,
    write_union,
)
from tracked_folder import motion

from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.prepare import mask_polarity, mask_values


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_single(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def subject(single: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return opened(single, tmp_path_factory.mktemp("out") / "rig")[0]


def test_every_camera_has_its_pose_and_lens(subject: Subject) -> None:
    cameras = subject.recording.cameras
    assert [camera.name for camera in cameras] == ["08", "07", "12"]  # the front one first
    for camera in cameras:
        np.testing.assert_allclose(camera.intrinsics, lens(camera.name), atol=1e-4)
        pose = np.array(from_front(camera.name))
        np.testing.assert_allclose(np.array(camera.R).reshape(3, 3), pose[:3, :3], atol=1e-5)
        np.testing.assert_allclose(camera.t, pose[:3, 3], atol=1e-5)


def test_the_head_lies_on_every_picture(subject: Subject, single: Path) -> None:
    """The mesh, posed and projected, covers what the camera's matte covers."""
    head = HeadModel(load_head_assets(single.parent / "head_model"), subject.identity)
    for index in range(len(subject)):
        frame = subject.frame(index)
        screen = frame.camera.project(head.vertices(frame.params))[:, :2].numpy()
        rows, columns = np.nonzero(frame.alpha.numpy() > 0.5)
        np.testing.assert_allclose(screen.min(axis=0), (columns.min(), rows.min()), atol=1.6)
        np.testing.assert_allclose(screen.max(axis=0), (columns.max() + 1, rows.max() + 1), atol=1.6)


def test_the_pictures_of_one_time_share_the_head(subject: Subject) -> None:
    recording = subject.recording
    assert len(recording.tracks["R"]) == SEQUENCES[0].times
    assert len(recording) == 3 * SEQUENCES[0].times
    tracks = motion(SEQUENCES[0].times, 10, SEQUENCES[0].seed)
    for index in range(len(subject)):
        time = int(recording.names[index].split("_")[0])
        assert recording.time(index) == time
        np.testing.assert_allclose(recording.tracks["R"][time], tracks[time]["R"], atol=1e-5)
        # What the network gets of the head's turn does not depend on the camera.
        torch.testing.assert_close(
            recording.camera(index).head_rotation, recording.tracks["R"][time], atol=1e-5, rtol=0
        )
    assert recording.moments(range(len(recording))) == tuple(
        recording.names.index(f"{time:05d}_08") for time in range(SEQUENCES[0].times)
    )


def test_the_front_camera_is_held_out_where_the_listing_has_it_for_validation(subject: Subject) -> None:
    recording = subject.recording
    train = {recording.names[i] for i in recording.split.train}
    assert train == {f"{time:05d}_{name}" for time in range(4) for name in ("07", "12")}
    assert len(recording.split.test) == len(recording) - len(train)


@pytest.mark.parametrize(
    ("choice", "train_cameras", "train_times"),
    [
        ({"test_cameras": "none"}, ("07", "08", "12"), 4),
        ({"test_cameras": "7"}, ("08", "12"), 4),
        ({"test_frames": 3}, ("07", "08", "12"), 3),
        ({"test_frames": 3, "test_cameras": "07, 12"}, ("08",), 3),
    ],
)
def test_times_and_cameras_are_held_out(
    choice: dict[str, Any], train_cameras: tuple[str, ...], train_times: int, single: Path, tmp_path: Path
) -> None:
    recording = opened(single, tmp_path / "out", **choice)[0].recording
    train = {recording.names[i] for i in recording.split.train}
    assert train == {f"{time:05d}_{name}" for time in range(train_times) for name in train_cameras}
    assert {*recording.split.train, *recording.split.test} == set(range(len(recording)))


def test_a_listing_without_test_frames_holds_out_its_validation_camera(single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    (folder / "transforms_test.json").unlink()
    recording = opened(folder, tmp_path / "out")[0].recording
    train = {recording.names[i] for i in recording.split.train}
    assert train == {f"{time:05d}_{name}" for time in range(4) for name in ("07", "12")}
    assert {recording.names[i] for i in recording.split.test} == {f"{time:05d}_08" for time in range(4)}
    every = opened(folder, tmp_path / "every", test_cameras="none")[0].recording
    assert {every.time(i) for i in every.split.train} == set(range(3))  # then the last time is tested


def test_cameras_are_chosen(single: Path, tmp_path: Path) -> None:
    two, said = opened(single, tmp_path / "two", cameras="8,12")
    assert [camera.name for camera in two.recording.cameras] == ["08", "12"]
    assert any("08, 12 are used" in line for line in said)
    front, _ = opened(single, tmp_path / "front", cameras="12")
    assert front.recording.rig is None
    assert len(front) == SEQUENCES[0].times
    with pytest.raises(UserError, match="no camera '99' among 07, 08, 12"):
        opened(single, tmp_path / "none", cameras="99")
    for name in ("none", "²", ""):
        with pytest.raises(UserError, match=f"--cameras: there is no camera '{name}'"):
            opened(single, tmp_path / "neither", cameras=name)
    with pytest.raises(UserError, match="every camera is held out"):
        opened(single, tmp_path / "all", test_cameras="07,08,12")


def test_what_a_validation_camera_tests_is_held_out_where_it_is_the_only_one(single: Path, tmp_path: Path) -> None:
    """Half of the times are tested, more than of a short clip without a division."""
    folder = edited(single, tmp_path / "copy", lambda _: None)
    every = [entry for file in folder.glob("*.json") for entry in json.loads(file.read_text())["frames"]]
    parts: dict[str | None, list[dict[str, Any]]] = {"train": [], "val": [], "test": []}
    for entry in every:
        early = "val" if entry["camera_id"] == "08" else "train"
        parts["test" if entry["timestep_index"] > 2 else early].append(entry)
    write_listings(folder, parts)
    subject, said = opened(folder, tmp_path / "out", cameras="08")
    assert subject.split == ((0, 1, 2), (3, 4, 5))
    assert "note: the folder names no training frames: those of validation are trained on" in said
    assert opened(folder, tmp_path / "asked", cameras="08", test_frames=1)[0].split.test == (5,)


def test_a_union_joins_sequences_of_other_worlds(tmp_path: Path) -> None:
    folder = write_union(tmp_path)
    subject, _ = opened(folder, tmp_path / "out")
    recording = subject.recording
    times = [sequence.times for sequence in SEQUENCES]
    tracks = [track for one in SEQUENCES for track in motion(one.times, 10, one.seed)]
    np.testing.assert_allclose(recording.tracks["R"], np.stack([track["R"] for track in tracks]), atol=1e-5)
    np.testing.assert_allclose(recording.tracks["t"], np.stack([track["t"] for track in tracks]), atol=1e-5)
    assert {recording.time(i) for i in recording.split.train} == set(range(times[0]))
    held_out_times = {recording.time(i) for i in recording.split.test if recording.names[i].startswith("FREE")}
    assert held_out_times == set(range(times[0], sum(times)))
    numbers = sorted({record.tracking for record in subject.manifest.frames})
    assert numbers == [*range(times[0]), *range(times[0] + 1, sum(times) + 1)]  # no frame follows across the cut
    assert subject.frame(0).image.shape == (56, 64, 3)


def turned(degrees: float, name: str = "12"):
    def edit(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == name:
            matrix = np.array(entry["transform_matrix"])
            matrix[:3, :3] = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0] @ matrix[:3, :3]
            entry["transform_matrix"] = matrix.tolist()

    return edit


def moving(entry: dict[str, Any]) -> None:
    turned(2.0 * entry["timestep_index"])(entry)


def same_camera(entry: dict[str, Any]) -> None:
    entry["camera_id"] = "08" if entry["camera_id"] == "07" else entry["camera_id"]


def alone(entry: dict[str, Any]) -> bool:
    return (entry["camera_id"] == "12") == (entry["timestep_index"] < 2)


def nameless(entry: dict[str, Any]) -> None:
    del entry["camera_id"], entry["camera_index"]


def outside(entry: dict[str, Any]) -> None:
    entry["file_path"] = f"../other/{entry['file_path']}"


HOSTILE = {
    "a camera that is calibrated 5 degrees off": (turned(5.0), "camera 12: .*does not lie on the masks.*calibration"),
    "a camera that moves": (moving, "camera 12 moves against camera 08, by up to"),
    "two pictures of one camera and time": (same_camera, "are both of camera 08 with 00000.npz"),
    "pictures of cameras that are not named": (
        nameless,
        "00000_0.* are both of camera None with 00000.npz; each needs",
    ),
    "a camera without a common time": (alone, "camera 12 has no picture of a time that camera 08 has one of"),
    "paths beside a folder that is no union": (outside, "leaves .*; give a folder that holds its own frames"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_rigs_are_refused_in_a_sentence(name: str, single: Path, tmp_path: Path) -> None:
    edit, sentence = HOSTILE[name]
    folder = edited(single, tmp_path / "copy", edit)
    with pytest.raises(UserError, match=sentence) as error:
        opened(folder, tmp_path / "out")
    assert "\n" not in str(error.value)


def test_a_missing_picture_is_left_out(single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    (folder / "images" / "00001_12.png").unlink()
    subject, said = opened(folder, tmp_path / "out", max_left_out=0.1)
    assert "00001_12" not in subject.recording.names
    assert any("left out 1 of 18 frames: 00001_12 (" in line for line in said)


@pytest.mark.parametrize("has_mattes", [True, False])
def test_a_camera_that_is_black_where_the_person_is_is_refused(has_mattes: bool, single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    for path in folder.glob("images/*_12.png"):
        matte = cv2.imread(str(folder / "fg_masks" / path.name))
        assert matte is not None and cv2.imwrite(str(path), (255 - matte) * has_mattes)
    if not has_mattes:
        (folder / "fg_masks").rename(tmp_path / "mattes")
    with pytest.raises(UserError, match="the pictures of camera 12 are black: 0.0 of 255"):
        opened(folder, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize(("value", "sentence"), [("inverted", "are inverted"), ("colours", "is a picture in colour")])
def test_masks_of_every_camera_are_looked_at(
    value: str, sentence: str, single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two samples of all pictures would leave a camera out."""
    monkeypatch.setattr(mask_polarity, "SAMPLED_FRAMES", 2)
    monkeypatch.setattr(mask_values, "SAMPLES", 2)
    folder = edited(single, tmp_path / "copy", lambda _: None)
    for path in folder.glob("fg_masks/*_08.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        other = 255 - mask if value == "inverted" else cv2.merge((mask // 4, mask // 2, mask))
        assert cv2.imwrite(str(path), other)
    with pytest.raises(UserError, match=sentence):
        opened(folder, tmp_path / "out")


def test_two_thousand_listed_pictures_that_are_not_there_are_refused(single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    content = json.loads((folder / "transforms_train.json").read_text())
    (entry,) = content["frames"][:1]
    content["frames"] += [
        entry | {"file_path": f"images/{n:05d}_07.png", "flame_param_path": f"flame_param/{n:05d}.npz"}
        for n in range(100, 2100)
    ]
    (folder / "transforms_train.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="2000 of 2018 images cannot be used, more than 5%") as error:
        opened(folder, tmp_path / "out")
    assert len(str(error.value)) < 2000


def test_two_sizes_within_a_camera_are_refused(single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    path = folder / "images" / "00002_07.png"
    assert cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (32, 28)))
    with pytest.raises(UserError, match="00002_07.png is 32x28 pixels but .*_07.png is 64x56"):
        opened(folder, tmp_path / "out")


def test_each_camera_has_its_own_size(single: Path, tmp_path: Path) -> None:
    def half(entry: dict[str, Any]) -> None:
        if entry["camera_id"] == "12":
            entry.update({key: entry[key] / 2 for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")})

    folder = edited(single, tmp_path / "copy", half)
    for path in [*folder.glob("images/*_12.png"), *folder.glob("fg_masks/*_12.png")]:
        assert cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (32, 28), interpolation=cv2.INTER_AREA))
    subject, _ = opened(folder, tmp_path / "out")
    index = subject.recording.names.index("00000_12")
    assert subject.frame(index).image.shape == (28, 32, 3)
    assert subject.image_size(index=index) == (32, 28)
    assert subject.image_size() == (64, 56)
    assert subject.frame(index, 48).image.shape == (42, 48, 3)

    without = edited(folder, tmp_path / "without", lambda entry: entry.pop("w") and entry.pop("h") and None)
    with pytest.raises(UserError, match=r"made on 64x56 .*_12.png is 32x28; give each listed frame the w and h of its"):
        opened(without, tmp_path / "refused")


def test_the_reference_is_where_the_head_is_seen_from_the_front() -> None:
    assert min(AZIMUTHS, key=lambda name: abs(AZIMUTHS[name])) == "08"
    np.testing.assert_allclose(from_front("12")[:3, :3] @ CENTRE + from_front("12")[:3, 3], CENTRE, atol=1e-12)
