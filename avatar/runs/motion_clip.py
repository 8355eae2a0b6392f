"""Motion that an avatar can show: frames of its own video, or another's motion carried over to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from avatar.errors import UserError
from avatar.head.model import HeadModel
from avatar.motion.drive import Drive, choose_cameras
from avatar.motion.transfer import transfer_motion
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera, HeadParams

Own = Literal["test", "train", "all"]
OWN: tuple[Own, ...] = ("test", "train", "all")


@dataclass(frozen=True)
class Clip:
    """T frames with the camera that holds the head's pose in each."""

    name: str
    fps: float
    frames: list[tuple[HeadParams, Camera]]
    recorded: tuple[int, ...] | None = None  # which frames of the avatar's own video these are

    def __len__(self) -> int:
        return len(self.frames)


def own_clip(trained: TrainedAvatar, which: str, size: int | None = None) -> Clip:
    """The held-out frames, those of training, or all of them (`which` of OWN), one of each time; `size` pixels wide.

    With several cameras all are seen by the one that has most of them. Raises UserError where there are none.
    """
    recording = trained.recording
    split = recording.split
    indices: Sequence[int] = {"test": split.test, "train": split.train, "all": range(len(recording))}[which]
    if len(indices) == 0:
        raise UserError(f"the video of {recording.name} has no {which} frames")
    counts = Counter(map(recording.view, indices))
    most = min(counts, key=lambda view: (-counts[view], view))
    filmed = {recording.time(index): index for index in indices if recording.view(index) == most}
    shown = tuple(filmed.get(recording.time(index), index) for index in recording.moments(indices))
    frames = [(recording.params(i), recording.camera(i, size, most)) for i in shown]
    return Clip(which, recording.fps, frames, shown)


def driven_clip(trained: TrainedAvatar, drive: Drive, size: int | None = None) -> Clip:
    """A drive as the avatar shows it: relative to both neutral faces, as `avatar reenact` does by default."""
    head = HeadModel(trained.assets, drive.identity)
    moved = transfer_motion(drive.params, trained.statistics, "relative", head).motion
    if drive.cameras is None:  # the torso would turn against a head that does not
        moved = [replace(params, neck=trained.rest_params().neck) for params in moved]
    cameras = choose_cameras(drive, trained.rest_camera(size), "driver", "target")
    return Clip(drive.name, drive.fps, list(zip(moved, cameras, strict=True)))
