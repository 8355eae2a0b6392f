"""Several sequences of one person, which are tracked as one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_recording import FILMED

from avatar.cli import main
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.track.camera_rig import recording, track_rig
from data_prep.track.camera_rig.camera_pictures import Times
from data_prep.track.footage.source import Span, whole

SERIALS = list(FILMED)


def sequences(raw: Path, tmp_path: Path) -> tuple[Path, Path]:
    """EXP-1 and FREE of one person, FREE without the last camera."""
    shutil.copytree(raw.parent.parent, tmp_path / "person")
    first = tmp_path / "person" / "sequences" / raw.name
    shutil.copytree(first, free := first.parent / "FREE")
    (free / "images" / f"cam_{SERIALS[2]}.mp4").unlink()
    return first, free


def test_sequences_are_joined_by_the_cameras_that_filmed_all(raw: Path, tmp_path: Path) -> None:
    """One picture of the grid stays empty between them, in every camera alike."""
    joined = track_rig._open(sequences(raw, tmp_path))
    assert list(joined.cameras) == SERIALS[:2] and joined.unused == (SERIALS[2],)
    assert joined.sequences == (("EXP-1", 0.0), ("FREE", pytest.approx(5 / 25)))
    footage = joined.cameras[SERIALS[0]].footage
    shown = [*footage.read(whole(64, 64), Span(), lambda _: None)]
    assert [round(picture.time * 25) for picture in shown] == [0, 1, 2, 3, 5, 6, 7, 8]
    assert np.abs(np.array([p.image.mean() for p in shown]) - 2 * FILMED[SERIALS[0]].greys).max() < 3
    part = [*footage.read(whole(64, 64), Span(3 / 25, 6.5 / 25), lambda _: None)]
    assert [round(picture.time * 25) for picture in part] == [3, 5, 6]


def test_sequences_are_given_from_within_one(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = sequences(raw, tmp_path)
    monkeypatch.chdir(first)
    joined = track_rig._open([Path(), Path("../FREE")])
    path = joined.cameras[SERIALS[0]].footage.path
    assert joined.folder == first.parent and path == first.parent / "*" / "images" / f"cam_{SERIALS[0]}.mp4"


def test_sequences_that_do_not_say_how_long_they_are_are_not_joined(raw: Path, tmp_path: Path) -> None:
    """A stream without a container: nothing would be read of it."""
    folders = sequences(raw, tmp_path)
    opened = [recording.open_recording(folder) for folder in folders]
    slower = [
        replace(one, cameras={s: replace(c, footage=replace(c.footage, rate=10.0)) for s, c in one.cameras.items()})
        for one in opened
    ]
    assert recording.join_recordings(slower).sequences[1] == ("FREE", pytest.approx(0.3))  # two pictures and none
    camera = opened[1].cameras[SERIALS[0]]
    opened[1].cameras[SERIALS[0]] = replace(camera, footage=replace(camera.footage, duration=None))
    with pytest.raises(UserError, match=f"FREE/images/cam_{SERIALS[0]}.mp4 does not say how long it is"):
        recording.join_recordings(opened)


def test_cameras_that_filmed_only_some_sequences_are_not_called_without_pictures(
    raw: Path, tmp_path: Path, demo_head_model: Path
) -> None:
    first, free = sequences(raw, tmp_path)
    head, said = load_head_assets(demo_head_model), []

    def stopped(*_: object) -> str:
        raise UserError("enough is said")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(UserError, match="enough is said"):
        patch.setattr(track_rig, "find_front", stopped)
        track_rig.track_rig((first, free), tmp_path / "out", demo_head_model, head, say=said.append)
    (note,) = said
    assert "without pictures in every sequence" in note and SERIALS[2] in note
    for serial in SERIALS[:2]:
        (first / "images" / f"cam_{serial}.mp4").unlink()
    with pytest.raises(UserError, match="pictures of no calibrated camera in every sequence"):
        track_rig.track_rig((first, free), tmp_path / "out", demo_head_model, head)


def test_all_recordings_are_named_where_one_of_them_is_not_beside_the_others(raw: Path, tmp_path: Path) -> None:
    first, free = sequences(raw, tmp_path)
    opened = [recording.open_recording(folder) for folder in (first, raw, free)]
    with pytest.raises(UserError, match=f"{first}, {raw}, {free} are not"):
        recording.join_recordings(opened)


def test_the_sequence_called_free_is_held_out(raw: Path, tmp_path: Path) -> None:
    joined, said = track_rig._open(sequences(raw, tmp_path)), []
    assert track_rig._held_out(joined, Times([1, 2, 5, 8], 0.0, 25.0), said.append) == {5, 8}
    assert said == ["EXP-1: times 1 to 2", "FREE: times 5 to 8, held out"]
    alone = replace(joined, sequences=(("FREE", 0.0),))
    assert track_rig._held_out(alone, Times([5, 8], 0.0, 25.0), said.append) == set() and "held" not in said[-1]


def test_recordings_that_do_not_belong_together_are_refused(
    raw: Path, gha: Path, tmp_path: Path, demo_head_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, free = sequences(raw, tmp_path)
    given = ["--out", str(tmp_path / "out"), "--head", str(demo_head_model)]
    for folders, more, said in (
        ((first, first), (), "different sequences beside each other"),
        ((first, raw), (), "different sequences beside each other"),
        ((first, gha), (), "only sequences of NeRSemble are tracked together"),
        ((gha, first), (), "only sequences of NeRSemble are tracked together"),
        ((first, free), ("--end", "1"), "--start and --end are of one sequence"),
        ((first, free), ("--focal", "900"), "leave out --focal"),
    ):
        assert main(["track", *map(str, folders), *given, *more]) != 0 and said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
