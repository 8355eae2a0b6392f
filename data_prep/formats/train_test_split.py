"""The split of a tracked folder: its own where it has one, else the rule of `avatar.data.split`; and its chosen cameras."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from avatar.data.split import Split, split_frames
from avatar.errors import UserError
from data_prep.formats.tracked_folder import Shot, TrackedFolder

ALL, FRONT = "all", "front"  # what --cameras may say beside names
NO_CAMERA = "none"


def split_frames_of(
    tracked: TrackedFolder, numbers: Sequence[int], test_frames: int | None = None, test_cameras: str | None = None
) -> tuple[Split, list[str]]:
    """Positions in `numbers` by the folder's own division, where it has one and no number of test frames is asked for, else
    by the rule of `split_frames`; and notes on it. A single frame or time is enough to drive with, and not divided
    (`check_divided`). With several cameras, times are divided, and cameras may be held out as well.

    test_frames   frames held out at the end; with several cameras, times
    test_cameras  names between commas, or "none"; None: as the folder says
    Raises UserError where there are too few frames, and for cameras that there are not.
    """
    shots, notes = tracked.shots, []
    parts = [tracked.division.get(number) for number in numbers]
    if test_frames is None and "train" not in parts and {"val", "test"} <= set(parts):
        # As of the camera that VHAP's listings validate with, when it is the only one: what they test stays held out.
        parts = ["train" if part == "val" else part for part in parts]
        notes.append("the folder names no training frames: those of validation are trained on")
    if shots:
        split, more = _divide_shots(parts, [shots[number] for number in numbers], test_frames, test_cameras)
        return split, [*notes, *more]
    if test_cameras not in (None, NO_CAMERA):
        raise UserError(f"data.test_cameras={test_cameras}: the frames are all of one camera")
    if len(numbers) == 1 and test_frames is None:
        return Split((0,), ()), ["there is a single frame: it can drive an avatar, and none can be trained on it"]
    listed = Split(*(tuple(i for i, part in enumerate(parts) if part == name) for name in ("train", "test")))
    if not any(parts) or test_frames is not None:
        return split_frames(len(numbers), test_frames), []
    if not listed.train or not listed.test:
        lacking = "test" if listed.train else "training"
        return split_frames(len(numbers), test_frames), [
            f"the folder names no {lacking} frames: its last ones are tested"
        ]
    left = len(parts) - len(listed.train) - len(listed.test)
    unused = f" ({left} are not used)" if left else ""
    return listed, [*notes, f"the folder's own division into training and test frames is kept{unused}"]


def _divide_shots(
    parts: Sequence[str | None], shots: Sequence[Shot], test_frames: int | None, test_cameras: str | None
) -> tuple[Split, list[str]]:
    held_out = named_cameras(test_cameras, {shot.camera for shot in shots})
    times = sorted({shot.time for shot in shots})
    if len(times) == 1:
        every = tuple(range(len(shots)))
        return Split(every, ()), ["the pictures are of a single time: they can drive an avatar, but not train one"]
    trained = {shot.camera for shot, part in zip(shots, parts, strict=True) if part == "train"}
    is_own = test_frames is None and bool(trained)
    if held_out is None:
        held_out = {shot.camera for shot in shots} - trained if is_own else set()
    tested = {shot.time for shot, part in zip(shots, parts, strict=True) if part == "test" and shot.camera in trained}
    notes, unused = [], set()
    if is_own and (tested or ("test" in parts and held_out)):
        # A folder of refined tracking names no part for what was of validation.
        used_times = {shot.time for shot, part in zip(shots, parts, strict=True) if part not in ("val", None)}
        unused = set(times) - tested - used_times
        left = f" ({len(unused)} are not used)" if unused else ""
        notes.append(f"the folder's own division into training and test times is kept{left}")
    else:
        tested = {times[place] for place in split_frames(len(times), test_frames).test}
    if held_out == {shot.camera for shot in shots}:
        raise UserError("every camera is held out, and none is left to train on: name fewer in data.test_cameras")
    if held_out:
        names = ", ".join(sorted(held_out))
        notes.append(
            f"{'camera' if len(held_out) == 1 else 'cameras'} {names} {'is' if len(held_out) == 1 else 'are'} held out"
        )
    used = [(i, shot) for i, shot in enumerate(shots) if shot.time not in unused]
    train = [i for i, shot in used if shot.time not in tested and shot.camera not in held_out]
    seen = set(train)
    if not train:
        raise UserError("no picture is left to train on: every time or camera is held out")
    return Split(tuple(train), tuple(i for i, _ in used if i not in seen)), notes


def chosen_cameras(
    chosen: str, cameras: Collection[str], front: Callable[[], str], folder: Path
) -> tuple[set[str], tuple[str, ...]]:
    """Those that --cameras names of a folder's: ALL, FRONT or names between commas; and a note where these are not all.

    front  the camera before the face
    Raises UserError for a name that no camera has.
    """
    try:
        found = set(cameras) if chosen == ALL else {front()} if chosen == FRONT else _named(chosen.split(","), cameras)
    except UserError as error:
        raise UserError(f"--cameras: {error} in {folder} (or say {ALL} or {FRONT})") from None
    if len(found) == len(cameras):
        return found, ()
    are = "is" if len(found) == 1 else "are"
    return found, (f"of the folder's {len(cameras)} cameras {', '.join(sorted(found))} {are} used",)


def named_cameras(names: str | None, cameras: Collection[str]) -> set[str] | None:
    """The cameras of a list between commas; None for None. A number may lack the zeros before it.

    Raises UserError for a name that no camera has.
    """
    if names is None:
        return None
    return set() if names == NO_CAMERA else _named(names.split(","), cameras)


def _named(names: Sequence[str], cameras: Collection[str]) -> set[str]:
    found = set()
    for name in (word.strip() for word in names):
        alike = (one for one in cameras if one.isdecimal() and name.isdecimal() and int(one) == int(name))
        same = [name] if name in cameras else list(alike)
        if not same:
            raise UserError(f"there is no camera {name!r} among {', '.join(sorted(cameras))}")
        found.add(same[0])
    return found
