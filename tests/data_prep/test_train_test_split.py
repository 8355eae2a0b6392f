"""Which cameras are used, which frames are held out, and what is said of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from avatar.data.split import Split
from avatar.errors import UserError
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.tracked_folder import Shot, TrackedFolder
from data_prep.formats.train_test_split import chosen_cameras, named_cameras, split_frames_of

CAMERAS = ("07", "08", "12")


@pytest.mark.parametrize(
    ("chosen", "cameras", "notes"),
    [
        ("all", {"07", "08", "12"}, ()),
        ("12, 7,8", {"07", "08", "12"}, ()),
        ("front", {"08"}, ("of the folder's 3 cameras 08 is used",)),
        ("012,7", {"07", "12"}, ("of the folder's 3 cameras 07, 12 are used",)),
    ],
)
def test_cameras_are_chosen_by_name_or_number(chosen: str, cameras: set[str], notes: tuple[str, ...]) -> None:
    assert chosen_cameras(chosen, CAMERAS, lambda: "08", Path("x")) == (cameras, notes)


def test_a_camera_of_just_this_name_comes_before_one_of_its_number() -> None:
    assert named_cameras("7", ("07", "7")) == {"7"} and named_cameras("07", ("7", "07")) == {"07"}


def test_a_camera_that_there_is_not_is_named_with_those_that_there_are() -> None:
    sentence = r"--cameras: there is no camera '9' among 07, 08, 12 in x \(or say all or front\)$"
    with pytest.raises(UserError, match=sentence):
        chosen_cameras("7,9", CAMERAS, lambda: "08", Path("x"))


def folder(parts: dict[int, str | None], times: int = 0) -> TrackedFolder:
    """Of one camera, or with `times` pictures by each of three, numbered camera after camera."""
    shots = {n * times + time: Shot(name, time) for n, name in enumerate(CAMERAS) for time in range(times)}
    read: Any = None
    return TrackedFolder("any", FrameFiles(Path(), {}), read, parts, shots=shots)


def test_a_folders_own_division_is_kept_and_what_it_lacks_is_said() -> None:
    parts: dict[int, str | None] = {0: "train", 1: "val", 2: "train", 3: "test"}
    split, notes = split_frames_of(folder(parts), range(4))
    assert split == Split((0, 2), (3,))
    assert notes == ["the folder's own division into training and test frames is kept (1 are not used)"]
    split, notes = split_frames_of(folder({0: "val", 1: "val", 2: "test"}), range(3))
    assert split == Split((0, 1), (2,)) and len(notes) == 2
    assert notes[0] == "the folder names no training frames: those of validation are trained on"
    for part, lacking in (("train", "test"), ("test", "training")):
        split, notes = split_frames_of(folder(dict.fromkeys(range(10), part)), range(10))
        assert split.test[-1] == 9 and notes == [f"the folder names no {lacking} frames: its last ones are tested"]
    split, notes = split_frames_of(folder(parts), range(4), test_frames=1)
    assert split == Split((0, 1, 2), (3,)) and notes == []
    split, notes = split_frames_of(folder({}), [5])
    assert split == Split((0,), ()) and notes[0].startswith("there is a single frame")
    with pytest.raises(UserError, match="data.test_cameras=08: the frames are all of one camera"):
        split_frames_of(folder({}), range(4), test_cameras="08")


@pytest.mark.parametrize(
    ("held_out", "train", "note"),
    [
        ("none", (0, 1, 2, 4, 5, 6, 8, 9, 10), None),
        ("8", (0, 1, 2, 8, 9, 10), "camera 08 is held out"),
        ("12,07", (4, 5, 6), "cameras 07, 12 are held out"),
    ],
)
def test_times_and_cameras_are_held_out(held_out: str, train: tuple[int, ...], note: str | None) -> None:
    split, notes = split_frames_of(folder({}, times=4), range(12), test_frames=1, test_cameras=held_out)
    assert split == Split(train, tuple(n for n in range(12) if n not in train))
    assert notes == ([] if note is None else [note])


def test_a_rigs_own_division_holds_out_the_cameras_that_train_nothing() -> None:
    parts: dict[int, str | None] = {0: "train", 1: "train", 2: "test", 3: "val"} | {
        n: "val" if n % 4 == 3 else "test" if n % 4 == 2 else "val" if n > 7 else "train" for n in range(4, 12)
    }
    split, notes = split_frames_of(folder(parts, times=4), range(12))
    assert split == Split((0, 1, 4, 5), (2, 6, 8, 9, 10))
    assert notes == [
        "the folder's own division into training and test times is kept (1 are not used)",
        "camera 12 is held out",
    ]
    with pytest.raises(UserError, match="every camera is held out"):
        split_frames_of(folder({}, times=4), range(12), test_cameras="7,8,12")
    single, notes = split_frames_of(folder({}, times=1), range(3))
    assert single == Split((0, 1, 2), ()) and notes[0].startswith("the pictures are of a single time")
