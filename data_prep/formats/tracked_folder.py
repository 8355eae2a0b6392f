"""The one form that every format of tracked folder is brought into before it is prepared."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from avatar.data.refinement_history import Refinement
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import Tracking
from data_prep.formats.transforms import ListedFrame


class Shot(NamedTuple):
    """What an image of a folder with several cameras shows."""

    camera: str
    time: int  # numbers of successive moments follow each other; between two sequences one is missing


@dataclass(frozen=True)
class TrackedFolder:
    """Which files belong to which frame, and how their tracking is read; nothing is decoded yet."""

    format: str
    files: FrameFiles
    # For a head model and the images' (width, height); the last is called, or raises, for what spoils the whole clip.
    read: Callable[[HeadAssets, tuple[int, int], Callable[[str], object]], Tracking]
    division: Mapping[int, str | None] = field(default_factory=dict)  # frame number -> "train", "val", "test"
    notes: tuple[str, ...] = ()
    fps: float | None = None  # of the video, where the layout records it
    refinement: Refinement | None = None  # where the tracking is no longer what the tracker left
    shots: Mapping[int, Shot] = field(default_factory=dict)  # by image number; empty where there is one camera
    read_given: Callable[[Callable[[str], object]], Tracking] | None = None  # what it left, for the same frames

    @property
    def is_paired(self) -> bool:
        """Whether the folder itself says which image belongs to which tracking, under the same number."""
        return bool(self.files.pairing)

    def refuse_offset(self, given: int | None) -> None:
        """Raises UserError for an offset that contradicts the folder's own pairing."""
        if self.is_paired and given:
            raise UserError(
                f"--frame-offset {given}: {self.files.pairing} itself says which image belongs to which "
                "tracking; leave it out"
            )


def spread_by_camera(numbers: Iterable[int], count: int, shots: Mapping[int, Shot] | None) -> list[int]:
    """About `count` of the images, as many of each camera, and one at least."""
    of_camera: dict[str, list[int]] = {}
    for number in numbers:
        of_camera.setdefault(shots[number].camera if shots else "", []).append(number)
    each = math.ceil(count / max(len(of_camera), 1))
    return [number for own in of_camera.values() for number in evenly_spread(own, each)]


def matte_notes(files: FrameFiles) -> tuple[str, ...]:
    """That the images' own transparency is used, in a layout that has another place for mattes."""
    return (
        (f"there is no {files.names.alphas}: the transparency of the images is taken as the matte",)
        if files.is_transparent
        else ()
    )


def listings_of(frames: list[ListedFrame]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(frame.listing for frame in frames))


def existing(paths: Mapping[int, Path | None]) -> dict[int, Path]:
    """The files that are there; all or nothing of a kind is not asked for."""
    return {number: path for number, path in paths.items() if path is not None and path.is_file()}
