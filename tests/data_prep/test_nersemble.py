"""Persons of NeRSemble's benchmark: cameras, pairing, what is held out, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nersemble_folder import (
    ASIDE,
    RATE,
    SEQUENCES,
    TRAINED,
    edit_tracking,
    edit_video,
    from_trained,
    lens,
    opened,
    video,
    write_person,
)
from tracked_folder import motion

from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.check.folder import check_tracked_folder
from data_prep.prepare.wrong_inputs import check_folder

TIMES = {name: times for name, (times, _) in SEQUENCES.items()}


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_person(tmp_path_factory.mktemp("person"))


@pytest.fixture(scope="module")
def subject(person: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return opened(person, tmp_path_factory.mktemp("out") / "rig")[0]


@pytest.fixture(scope="module")
def public(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What can be downloaded: the trained camera, without the tested sequences."""
    return write_person(tmp_path_factory.mktemp("public"), cameras=[TRAINED], sequences=list(SEQUENCES)[1:])


@pytest.fixture
def copy(person: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(person, tmp_path / "393"))


def assert_head_on_mattes(subject: Subject, folder: Path) -> None:
    """The mesh, posed and projected, covers what the matte covers."""
    head = HeadModel(load_head_assets(folder / "head_model"), subject.identity)
    for index in range(len(subject)):
        frame = subject.frame(index)
        screen = frame.camera.project(head.vertices(frame.params))[:, :2].numpy()
        rows, columns = np.nonzero(frame.alpha.numpy() > 0.5)
        assert 100 < len(rows) < 3000
        np.testing.assert_allclose(screen.min(axis=0), (columns.min(), rows.min()), atol=1.7)
        np.testing.assert_allclose(screen.max(axis=0), (columns.max() + 1, rows.max() + 1), atol=1.7)


def test_the_head_lies_on_every_picture_of_every_camera(subject: Subject, person: Path) -> None:
    assert_head_on_mattes(subject, person)
    recording = subject.recording
    assert recording.fps == RATE and subject.manifest.format == "NeRSemble"
    assert [camera.name for camera in recording.cameras] == [TRAINED, ASIDE]
    for camera in recording.cameras:
        K = lens(camera.name)
        np.testing.assert_allclose(camera.intrinsics, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), atol=1e-4)
        np.testing.assert_allclose(np.reshape(camera.R, (3, 3)), from_trained(camera.name)[:3, :3], atol=1e-5)
        np.testing.assert_allclose(camera.t, from_trained(camera.name)[:3, 3], atol=1e-5)
    tracks = [track for times, seed in SEQUENCES.values() for track in motion(times, 10, seed)]
    for name in ("R", "t", "expression"):
        np.testing.assert_allclose(recording.tracks[name], np.stack([track[name] for track in tracks]), atol=1e-5)


def test_tested_sequences_and_other_cameras_are_held_out(subject: Subject) -> None:
    recording = subject.recording
    trained = {recording.names[i] for i in recording.split.train}
    names = [f"{name}_{TRAINED}_{n:05d}" for name, times in TIMES.items() for n in range(times)]
    assert trained == {name for name in names if not name.startswith("EMO-1")}
    assert len(recording.split.test) == len(recording) - len(trained)
    numbers = sorted({frame.tracking for frame in subject.manifest.frames})
    assert np.flatnonzero(np.diff(numbers) > 1).tolist() == [3, 9]  # no frame follows across the cuts


def test_other_cameras_are_held_out_where_no_sequence_is_tested(copy: Path, tmp_path: Path) -> None:
    shutil.rmtree(copy / "sequences" / "EMO-1-shout+laugh")
    recording = opened(copy, tmp_path / "out")[0].recording
    trained = {recording.names[i] for i in recording.split.train}
    assert trained and all(TRAINED in name for name in trained)
    assert {recording.time(i) for i in recording.split.train} == set(range(8))  # of 10: the last are tested
    both = opened(copy, tmp_path / "both", test_cameras="none")[0].recording
    assert len(both.split.train) == 16


def test_the_public_download_is_of_one_camera(public: Path, tmp_path: Path) -> None:
    subject, said = opened(public, tmp_path / "out")
    assert subject.recording.rig is None and len(subject) == 10
    assert subject.split == (tuple(range(8)), (8, 9))
    assert_head_on_mattes(subject, public)
    assert not any("skips" in line for line in said)
    assert np.diff([frame.tracking for frame in subject.manifest.frames]).tolist() == [*[1] * 5, 2, *[1] * 3]


def test_cameras_are_chosen(person: Path, tmp_path: Path) -> None:
    front, said = opened(person, tmp_path / "front", cameras="front")
    assert front.recording.rig is None and len(front) == sum(TIMES.values())
    assert any(f"of the folder's 2 cameras {TRAINED} is used" in line for line in said)
    aside, _ = opened(person, tmp_path / "aside", cameras=ASIDE)
    assert aside.recording.names[0] == f"EMO-1-shout+laugh_{ASIDE}_00000"
    with pytest.raises(UserError, match="no camera '99' among"):
        opened(person, tmp_path / "none", cameras="99")


def test_rows_are_the_pictures_whatever_the_recording_numbered_them(
    copy: Path, subject: Subject, tmp_path: Path
) -> None:
    edit_tracking(copy, lambda values: values.update(frames=10 + 3 * values["frames"]))
    renumbered, _ = opened(copy, tmp_path / "out")
    assert renumbered.data_hash == subject.data_hash


def test_frames_are_positions_where_the_video_has_more(tmp_path: Path) -> None:
    positions = [1, 3, 5, 9, 11, 13]
    folder = write_person(tmp_path, cameras=[TRAINED], sequences=["EXP-1-head"], positions=positions)
    subject, _ = opened(folder, tmp_path / "out")
    assert_head_on_mattes(subject, folder)
    assert [frame.name for frame in subject.manifest.frames] == [f"{n:05d}" for n in positions]
    assert [frame.tracking for frame in subject.manifest.frames] == [0, 1, 2, 4, 5, 6]  # 7 is missing
    assert subject.recording.fps == RATE / 2


@pytest.mark.parametrize(
    "name", ["flame2023_tracking_v2.npz", pytest.param("flame2023_tracking.npz", marks=pytest.mark.slow)]
)
def test_angles_and_the_older_name_are_read(name: str, copy: Path, subject: Subject, tmp_path: Path) -> None:
    edit_tracking(copy, lambda values: values.pop("rotation_matrices"))
    for path in list(copy.glob("sequences/*/tracking/*.npz")):
        path.rename(path.with_name(name))
    tracks = opened(copy, tmp_path / "out")[0].recording.tracks
    torch.testing.assert_close(tracks["R"], subject.recording.tracks["R"], atol=1e-5, rtol=0)


def test_pictures_are_decoded_once_and_again_where_the_video_changes(copy: Path, tmp_path: Path) -> None:
    subject, _ = opened(copy, tmp_path / "out", cameras=TRAINED)
    picture = Path(subject.manifest.source) / subject.manifest.frames[0].image
    before = picture.stat().st_mtime_ns
    opened(copy, tmp_path / "again", cameras=TRAINED)
    assert picture.stat().st_mtime_ns == before
    edit_video(video(copy), lambda pictures: [255 - one for one in pictures])
    changed, _ = opened(copy, tmp_path / "changed", cameras=TRAINED)
    assert picture.stat().st_mtime_ns > before and changed.data_hash != subject.data_hash
    picture.unlink()
    assert opened(copy, tmp_path / "lost", cameras=TRAINED)[0].data_hash == changed.data_hash


def test_a_camera_that_lacks_a_sequence_is_noted(copy: Path, tmp_path: Path) -> None:
    for kind in ("images", "alpha_maps"):
        video(copy, ASIDE, "EXP-1-head", kind).unlink()
    subject, said = opened(copy, tmp_path / "out")
    assert len(subject) == 2 * sum(TIMES.values()) - TIMES["EXP-1-head"]
    assert any(f"there is no video of EXP-1-head by {ASIDE}" in line for line in said)


def test_sequences_without_tracking_are_noted(copy: Path, tmp_path: Path) -> None:
    shutil.rmtree(copy / "sequences" / "EXP-1-head" / "tracking")
    subject, said = opened(copy, tmp_path / "out")
    assert not any("EXP-1" in name for name in subject.recording.names)
    assert any("sequences without tracking are left out: EXP-1-head" in line for line in said)


@pytest.mark.parametrize("part", ["sequences", "sequences/EXP-1-head", "calibration"])
def test_a_part_of_the_folder_is_not_taken_for_it(part: str, person: Path) -> None:
    with pytest.raises(UserError, match="give .*393|holds nothing"):
        check_folder(person / part)
    check_folder(person)
    with pytest.raises(UserError, match="it holds 393/; give it"):
        check_folder(person.parent)


def test_check_finds_nothing_wrong(person: Path) -> None:
    outcome = check_tracked_folder(person, lambda: load_head_assets(person / "head_model"))
    assert not [finding for finding in outcome.findings if finding.severity == "error" or finding.check == "gaps"]
    assert outcome.clip is not None
    assert len(outcome.clip.files.images) == sum(TIMES.values())  # of the front camera
