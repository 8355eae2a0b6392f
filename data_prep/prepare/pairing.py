"""Image numbers with their tracking numbers, and what has to be left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avatar.errors import UserError
from data_prep.formats.frame_files import FrameFiles, describe_numbers, gaps
from data_prep.formats.frame_track import Tracking
from data_prep.formats.tracked_folder import Shot
from data_prep.prepare.frame_offset import RADIUS
from data_prep.prepare.inspect_images import Inspection

BEHIND_CAMERA = "the tracked head is behind the camera"
REPEATS = "the tracking repeats that of the frame before, while the image does not"
_REASONS_SHOWN = 5


@dataclass(frozen=True)
class Pairing:
    pairs: tuple[tuple[int, int], ...]  # (image number, tracking number) of the usable frames, increasing
    left_out: dict[int, str]  # image number -> reason
    notes: list[str]


class TooManyLeftOut(UserError):
    """More frames are unusable than --max-left-out allows; `problem` is the sentence without that advice."""

    def __init__(self, problem: str, advice: str) -> None:
        super().__init__(f"{problem}{advice}")
        self.problem = problem


def refuse_if_many(bad: Mapping[int, str], total: int, what: str, share: float) -> None:
    """Raise TooManyLeftOut when more than `share` of `total` are bad: then something is wrong with the whole."""
    if len(bad) > share * total:
        raise TooManyLeftOut(
            f"{len(bad)} of {total} {what} cannot be used, more than {share:.0%}: {describe_reasons(bad)}",
            "; mend them, or allow more with --max-left-out",
        )


def describe_reasons(bad: Mapping[int, str], name: Callable[[int], str] = "{:05d}".format) -> str:
    """`00002-00004 (all zero: ...), 00007 (...)`, grouped by reason."""
    shown = [f"{describe_numbers(numbers, name=name)} ({reason})" for reason, numbers in grouped(bad).items()]
    rest = len(shown) - _REASONS_SHOWN
    return ", ".join(shown[:_REASONS_SHOWN]) + (f" and {rest} more reasons" if rest > 0 else "")


def grouped(words: Mapping[int, str]) -> dict[str, list[int]]:
    """The numbers that have each of the words."""
    groups: dict[str, list[int]] = {}
    for number, word in words.items():
        groups.setdefault(word, []).append(number)
    return groups


def pair_frames(
    files: FrameFiles,
    inspection: Inspection,
    tracking: Tracking,
    offset: int,
    head_centre: np.ndarray,
    max_left_out: float,
    shots: Mapping[int, Shot] | None = None,
) -> Pairing:
    """Pair image n + offset with tracking n; leave out what is bad on either side or repeats its neighbour's tracking.

    Raises UserError when the numbers do not fit together or more than that share would be left out.
    """
    notes = _count_notes(files)
    numbered = [(n + offset, n) for n in files.tracking if n + offset in files.images]
    if not numbered:
        raise UserError(
            f"no image belongs to a tracking frame under offset {offset}: images are {_range(files.images)}, "
            f"tracking is {_range(files.tracking)}; give another --frame-offset"
        )
    _refuse_if_unpaired(files, len(numbered), offset, max_left_out)
    left_out = unusable(numbered, tracking, inspection.bad, inspection.image_digests, head_centre, shots)
    refuse_if_many(left_out, len(numbered), "frames", max_left_out)
    return Pairing(tuple(pair for pair in numbered if pair[0] not in left_out), left_out, notes)


def unusable(
    pairs: Sequence[tuple[int, int]],
    tracking: Tracking,
    bad: Mapping[int, str],
    digests: Mapping[int, bytes],
    head_centre: np.ndarray | None,
    shots: Mapping[int, Shot] | None = None,
) -> dict[int, str]:
    """Image number -> why the frame cannot be used, for pairs of image number and tracking number.

    `bad` says which images cannot be used, `digests` are of all of them; without a head model, none lies behind the camera.
    With `shots` of several cameras each picture is compared with the one before of the same camera.
    """
    left_out: dict[int, str] = {}
    previous: dict[str, tuple[int, int, np.ndarray]] = {}  # by camera: time, image, tracking
    for image, number in pairs:
        if number in tracking.bad:
            left_out[image] = tracking.bad[number]
            continue
        track = tracking.frames[number]
        values = track.moving_values()
        camera, time = shots[image] if shots else ("", number)
        before = previous.get(camera)
        repeats = before is not None and before[0] == time - 1 and np.array_equal(before[2], values)
        if image in bad:
            left_out[image] = bad[image]
        elif head_centre is not None and (track.R @ head_centre + track.t)[2] <= 0:
            left_out[image] = BEHIND_CAMERA
        elif before is not None and repeats and digests[image] != digests[before[1]]:
            left_out[image] = REPEATS
        previous[camera] = time, image, values
    return left_out


def _count_notes(files: FrameFiles) -> list[str]:
    notes = []
    for kind, found in files.of_kind().items():
        missing = gaps(found) if files.is_numbered_by_names else []
        if missing:
            notes.append(f"{files.title(kind)} skips the numbers {describe_numbers(missing)}")
        if kind != "checkpoint" and found and len(found) != len(files.images):
            notes.append(f"{files.title(kind)} has {len(found)} files for {len(files.images)} images")
    if len(files.tracking) != len(files.images):
        notes.append(f"there are {len(files.images)} images and {len(files.tracking)} tracking frames")
    return notes


def _refuse_if_unpaired(files: FrameFiles, paired: int, offset: int, share: float) -> None:
    """An offset leaves a few frames at the ends without partner; many mean that the two are not of one video."""
    for kind, found in (("images", files.images), ("tracking frames", files.tracking)):
        unpaired = len(found) - paired
        if unpaired > max(share * len(found), RADIUS):
            raise TooManyLeftOut(
                f"{unpaired} of {len(found)} {kind} have no partner under offset {offset}: images are "
                f"{_range(files.images)}, tracking is {_range(files.tracking)}",
                "; are they of the same video? If so, allow more with --max-left-out",
            )


def _range(found: Mapping[int, object]) -> str:
    return f"{len(found)} files numbered {min(found):05d} to {max(found):05d}"
