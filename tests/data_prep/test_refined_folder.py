"""The folder that refinement writes: read back as any tracked folder, with what it was before; whole or not there."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nha_folder import write_nha
from tracked_folder import write_tracked_folder

from avatar.data.refinement_history import Refinement, Round
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from data_prep.check.folder import check_tracked_folder
from data_prep.formats import refined_folder
from data_prep.formats.avatar_track import read_info
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.refined_folder import GIVEN_FILE, REFINEMENT_FILE, check_target, frame_numbers, write_folder
from data_prep.prepare.open_subject import find_head, open_subject

FRAMES = 20


def opened(folder: Path, head: Path | None = None, test_frames: int | None = None) -> Subject:
    return open_subject(Source(folder, head or find_head(folder)), test_frames, lambda _: None)[0]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("tracked") / "someone", frames=FRAMES, size=48)


@pytest.fixture(scope="module")
def subject(original: Path) -> Subject:
    return open_subject(Source(original, original / "head_model", frame_offset=1), None, lambda _: None)[0]


def better(subject: Subject) -> dict[str, torch.Tensor]:
    tracks = {name: value.clone() for name, value in subject.recording.tracks.items()}
    tracks["t"] += torch.tensor([0.0005, 0.0, -0.0005])
    tracks["expression"] *= 0.9
    return tracks


def history(subject: Subject, run: str = "/runs/first") -> Refinement:
    numbers = frame_numbers(subject)
    return Refinement("metrical-tracker", (Round(run, 600, "ab" * 32, tuple(numbers[i] for i in subject.split.train)),))


@pytest.fixture(scope="module")
def written(subject: Subject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = Path(os.path.relpath(tmp_path_factory.mktemp("out") / "someone"))
    write_folder(target, subject, better(subject), history(subject), {"refinement.csv": b"frame\n"})
    return target.resolve()


def test_it_is_read_back_with_both_trackings(written: Path, subject: Subject) -> None:
    again = opened(written)
    assert again.name == "someone" and again.manifest.format == "avatar-track"
    assert read_info(written).head_path == str((written / "head_model").resolve())
    assert again.recording.names == subject.recording.names and again.recording.fps == subject.recording.fps
    assert again.split == subject.split and again.manifest.refinement == history(subject)
    assert again.given is not None
    for name, value in better(subject).items():
        assert torch.allclose(again.recording.tracks[name], value, atol=1e-6), name
        assert torch.allclose(again.given.tracks[name], subject.recording.tracks[name], atol=1e-6), name
    assert again.recording.intrinsics == pytest.approx(subject.recording.intrinsics)
    assert (written / "refinement.csv").read_bytes() == b"frame\n"
    assert any("was refined through the avatar of /runs/first" in note for note in again.manifest.notes)


def test_what_was_assumed_of_the_focal_length_stays_assumed(written: Path, tmp_path: Path) -> None:
    assert not read_info(written).focal_is_assumed
    shutil.copytree(written, tmp_path / "tracked")
    info = json.loads((tmp_path / "tracked" / "tracking.json").read_text())
    info |= {"focal": "that of a field of view of 63 degrees", "focal_is_assumed": True}
    (tmp_path / "tracked" / "tracking.json").write_text(json.dumps(info))
    own = opened(tmp_path / "tracked")
    write_folder(tmp_path / "again", own, better(own), history(own), {})
    again = read_info(tmp_path / "again")
    assert (again.focal, again.focal_is_assumed) == ("that of a field of view of 63 degrees", True)


def test_frames_are_the_same_pixels_and_take_no_room(written: Path, subject: Subject) -> None:
    again = opened(written)
    for index in (0, 7, FRAMES - 1):
        ours, theirs = again.frame(index), subject.frame(index)
        for name in ("image", "alpha", "head_mask", "mouth_mask"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name))
    first = Path(subject.manifest.source) / subject.manifest.frames[0].image
    assert first.samefile(written / "frames" / first.name)


def test_pictures_are_copied_where_they_cannot_be_linked(
    subject: Subject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_link(*_: object) -> None:
        raise OSError("another disk")

    monkeypatch.setattr(refined_folder.os, "link", no_link)
    write_folder(tmp_path / "copy", subject, better(subject), history(subject), {})
    first = Path(subject.manifest.source) / subject.manifest.frames[0].image
    assert (tmp_path / "copy" / "frames" / first.name).read_bytes() == first.read_bytes()
    assert not first.samefile(tmp_path / "copy" / "frames" / first.name)


def test_the_original_may_go(subject: Subject, original: Path, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    shutil.copytree(original, gone)
    own = open_subject(Source(gone, gone / "head_model", frame_offset=1), None, lambda _: None)[0]
    write_folder(tmp_path / "refined", own, better(own), history(own), {})
    shutil.rmtree(gone)
    assert opened(tmp_path / "refined").frame(3).image.shape == (48, 48, 3)


def test_a_head_model_elsewhere_is_named_not_copied(original: Path, tmp_path: Path) -> None:
    shutil.copytree(original, tmp_path / "someone")
    (tmp_path / "someone" / "head_model").rename(tmp_path / "licensed")
    source = Source(tmp_path / "someone", tmp_path / "licensed", frame_offset=1)
    own = open_subject(source, None, lambda _: None)[0]
    write_folder(tmp_path / "refined", own, better(own), history(own), {})
    assert not (tmp_path / "refined" / "head_model").exists()
    assert find_head(tmp_path / "refined") == tmp_path / "licensed"
    (tmp_path / "licensed").rename(tmp_path / "moved")
    with pytest.raises(UserError, match="no head model"):
        find_head(tmp_path / "refined")
    assert opened(tmp_path / "refined", tmp_path / "moved").given is not None


def test_masks_that_were_made_come_along(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "bare", frames=12, size=48, mouth_masks=False)
    own = open_subject(Source(folder, folder / "head_model", frame_offset=1), None, lambda _: None)[0]
    assert own.manifest.mouth_masks == "derived"
    write_folder(tmp_path / "refined", own, better(own), history(own), {})
    again = opened(tmp_path / "refined")
    assert again.manifest.mouth_masks == "source"
    assert torch.equal(again.frame(4).mouth_mask, own.frame(4).mouth_mask)


def test_labels_become_masks(tmp_path: Path) -> None:
    """NHA's have several that are the person: without the layout they would be faint mattes."""
    own = opened(write_nha(tmp_path / "person"))
    write_folder(tmp_path / "refined", own, better(own), history(own), {})
    again = opened(tmp_path / "refined")
    for name in ("alpha", "head_mask", "mouth_mask"):
        assert torch.equal(getattr(again.frame(4), name), getattr(own.frame(4), name))


def test_pictures_that_are_their_own_mattes_stay_so_where_one_is_opaque(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "someone", frames=20, size=48, suffix=".png")
    for path in sorted((folder / "imgs").iterdir()):
        matte = cv2.imread(str(folder / "alpha" / path.name), cv2.IMREAD_GRAYSCALE)
        picture = cv2.imread(str(path))
        assert matte is not None and picture is not None
        assert cv2.imwrite(str(path), np.dstack((picture, np.full_like(matte, 255) if "05" in path.name else matte)))
    shutil.rmtree(folder / "alpha")
    own = open_subject(Source(folder, folder / "head_model", frame_offset=1), None, lambda _: None)[0]
    write_folder(tmp_path / "refined", own, better(own), history(own), {})
    again = opened(tmp_path / "refined")
    for index in (3, 4):
        assert torch.equal(again.frame(index).alpha, own.frame(index).alpha)
    assert own.frame(4).alpha.min() == 1


def test_a_second_round_keeps_what_the_tracker_left(written: Path, subject: Subject, tmp_path: Path) -> None:
    first = opened(written)
    tracks = {**first.recording.tracks, "eyelids": first.recording.tracks["eyelids"] + 0.01}
    rounds = (*history(subject).rounds, *history(subject, "/runs/second").rounds)
    write_folder(tmp_path / "twice", first, tracks, replace(history(subject), rounds=rounds), {})
    twice = opened(tmp_path / "twice")
    assert twice.given is not None and twice.manifest.refinement is not None
    assert torch.allclose(twice.given.tracks["t"], subject.recording.tracks["t"], atol=1e-6)
    assert torch.allclose(twice.recording.tracks["eyelids"], tracks["eyelids"], atol=1e-6)
    assert [one.run for one in twice.manifest.refinement.rounds] == ["/runs/first", "/runs/second"]
    assert frame_numbers(twice) == frame_numbers(subject)


def test_another_division_shows_which_frames_had_been_trained_on(written: Path) -> None:
    again = opened(written, test_frames=10)
    numbers = [again.manifest.frames[index].tracking for index in again.split.test]
    assert again.manifest.refinement is not None
    assert again.manifest.refinement.trained_on(numbers) == numbers[:6]


def test_the_check_takes_it_like_any_folder(written: Path) -> None:
    from avatar.head.assets import load_head_assets

    outcome = check_tracked_folder(written, lambda: load_head_assets(written / "head_model"))
    assert not [finding for finding in outcome.findings if finding.severity == "error"]
    assert outcome.clip is not None and outcome.clip.source.format == "avatar-track"


def test_a_refined_folder_is_noticed_when_its_origin_changes(written: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(written, copy)
    before = opened(copy)
    arrays = dict(np.load(copy / GIVEN_FILE))
    arrays["t"][3] += 0.01
    np.savez(copy / GIVEN_FILE, **arrays)
    after = opened(copy)
    assert after.given is not None and before.given is not None
    assert not torch.equal(after.given.tracks["t"][3], before.given.tracks["t"][3])
    assert after.data_hash != before.data_hash


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda raw: raw.update(version=9), "not of version 3"),
        (lambda raw: raw["refinement"].pop("tracker"), "refinement.tracker is missing"),
        (lambda raw: raw["refinement"].update(rounds=[]), "no rounds"),
        (lambda raw: raw["refinement"]["rounds"][0].update(step="x"), "step is not a whole number"),
        (lambda raw: raw["refinement"]["rounds"][0].update(trained_on=["x"]), r"trained_on\[0\] is not a whole number"),
        (lambda raw: raw.pop("division"), "'division'"),
        (lambda raw: raw.pop("rig"), "'rig'"),
        (lambda raw: raw.update(division={"x": "train"}), "damaged"),
    ],
)
def test_a_damaged_record_is_a_sentence(written: Path, tmp_path: Path, change, said: str) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(written, copy)
    raw = json.loads((copy / REFINEMENT_FILE).read_text())
    change(raw)
    (copy / REFINEMENT_FILE).write_text(json.dumps(raw))
    with pytest.raises(UserError, match=said) as error:
        open_tracked_folder(copy)
    assert REFINEMENT_FILE in str(error.value)


def test_a_missing_or_short_original_tracking_is_a_sentence(written: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(written, copy)
    (copy / GIVEN_FILE).unlink()
    with pytest.raises(UserError, match=GIVEN_FILE.replace(".", r"\.")):
        opened(copy)
    arrays = dict(np.load(written / GIVEN_FILE))
    short = {name: value[:-2] if name != "shape" else value for name, value in arrays.items()}
    np.savez(copy / GIVEN_FILE, **short)
    with pytest.raises(UserError, match="lacks"):
        opened(copy)


def test_nothing_is_overwritten_and_nothing_left_half_written(
    subject: Subject, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="exists already"):
        write_folder(written, subject, better(subject), history(subject), {})
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="exists already"):
        check_target(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    check_target(tmp_path / "empty")
    own = Path.write_text
    monkeypatch.setattr(Path, "write_text", lambda self, *a, **k: fail_or(own, self, a, k))
    with pytest.raises(UserError, match="nothing was left behind"):
        write_folder(tmp_path / "empty", subject, better(subject), history(subject), {})
    monkeypatch.undo()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "file"]
    assert not any((tmp_path / "empty").iterdir())
    write_folder(tmp_path / "empty", subject, better(subject), history(subject), {})
    assert opened(tmp_path / "empty").given is not None


def fail_or(own, path: Path, positional: tuple, named: dict) -> int:
    if path.name == REFINEMENT_FILE:
        raise OSError(28, "No space left on device")
    return own(path, *positional, **named)
