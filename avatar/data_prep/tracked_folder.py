"""The one form that every format of tracked folder is brought into before it is prepared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from avatar.data_prep.frame_files import FrameFiles
from avatar.data_prep.tracking import Tracking
from avatar.data_prep.transforms import ListedFrame
from avatar.head.assets import HeadAssets


@dataclass(frozen=True)
class TrackedFolder:
    """Which files belong to which frame, and how their tracking is read; nothing is decoded yet."""

    format: str
    files: FrameFiles
    read: Callable[[HeadAssets, tuple[int, int]], Tracking]  # for a head model and the images' (width, height)
    division: Mapping[int, str | None] = field(default_factory=dict)  # frame number -> "train", "val", "test"
    notes: tuple[str, ...] = ()

    @property
    def is_paired(self) -> bool:
        """Whether the folder itself says which image belongs to which tracking, under the same number."""
        return bool(self.files.listings)


def numbered(frames: list[ListedFrame]) -> dict[int, ListedFrame]:
    return dict(enumerate(frames))


def listings_of(frames: list[ListedFrame]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(frame.listing for frame in frames))


def existing(paths: Mapping[int, Path | None]) -> dict[int, Path]:
    """The files that are there; all or nothing of a kind is not asked for."""
    return {number: path for number, path in paths.items() if path is not None and path.is_file()}
