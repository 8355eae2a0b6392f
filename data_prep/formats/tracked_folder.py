"""The one form that every format of tracked folder is brought into before it is prepared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from avatar.data.refinement import Refinement
from avatar.data.split import Split, split_frames
from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import Tracking
from data_prep.formats.transforms import ListedFrame


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
    read_given: Callable[[Callable[[str], object]], Tracking] | None = None  # what it left, for the same frames

    @property
    def is_paired(self) -> bool:
        """Whether the folder itself says which image belongs to which tracking, under the same number."""
        return bool(self.files.listings)

    def refuse_offset(self, given: int | None) -> None:
        """Raises UserError for an offset that contradicts the folder's own pairing."""
        if self.is_paired and given:
            raise UserError(
                f"--frame-offset {given}: {self.files.listings[0].name} itself says which image belongs to which "
                "tracking; leave it out"
            )


def divide(
    division: Mapping[int, str | None], numbers: Sequence[int], test_frames: int | None
) -> tuple[Split, list[str]]:
    """Positions in `numbers` by the folder's own division, where it has one and no number of test frames is asked for, else
    by the rule of `split_frames`; and notes on it. A single frame is all there is to drive with, and not divided
    (`check_divided`). Raises UserError where there are too few frames."""
    if len(numbers) == 1 and test_frames is None:
        return Split((0,), ()), ["there is a single frame: it can drive an avatar, and none can be trained on it"]
    parts = [division.get(number) for number in numbers]
    listed = Split(*(tuple(i for i, part in enumerate(parts) if part == name) for name in ("train", "test")))
    if not any(parts) or test_frames is not None:
        return split_frames(len(numbers), test_frames), []
    if not listed.train or not listed.test:
        lacking = "test" if listed.train else "training"
        return split_frames(len(numbers), test_frames), [
            f"the folder names no {lacking} frames: its last ones are tested"
        ]
    left = len(parts) - len(listed.train) - len(listed.test)
    unused = f" ({left} of validation are not used)" if left else ""
    return listed, [f"the folder's own division into training and test frames is kept{unused}"]


def matte_notes(files: FrameFiles) -> tuple[str, ...]:
    """That the images' own transparency is used, in a layout that has another place for mattes."""
    return (
        (f"there is no {files.names.alphas}: the transparency of the images is taken as the matte",)
        if files.is_transparent
        else ()
    )


def numbered(frames: list[ListedFrame]) -> dict[int, ListedFrame]:
    return dict(enumerate(frames))


def listings_of(frames: list[ListedFrame]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(frame.listing for frame in frames))


def existing(paths: Mapping[int, Path | None]) -> dict[int, Path]:
    """The files that are there; all or nothing of a kind is not asked for."""
    return {number: path for number, path in paths.items() if path is not None and path.is_file()}
