"""With several cameras: which camera a frame is of, and whether its time or its camera was held out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

from avatar.data.recording import Recording

HeldOut = Literal["time", "camera", "time and camera", "picture"]


class View(NamedTuple):
    """What a frame of several cameras is a picture of. Field names are columns of frames.csv."""

    camera: str
    time: int  # number of the tracking frame; successive ones follow each other in the video
    held_out: HeldOut  # "picture": both its time and its camera have other pictures in training


def views(recording: Recording, numbers: Mapping[int, int], indices: Iterable[int]) -> dict[int, View]:
    """By index; empty with one camera. `numbers` are of the frames' tracking."""
    if recording.rig is None:
        return {}
    times = {recording.time(i) for i in recording.split.train}
    cameras = {recording.view(i) for i in recording.split.train}

    def held_out(index: int) -> HeldOut:
        if recording.time(index) not in times:
            return "time" if recording.view(index) in cameras else "time and camera"
        return "picture" if recording.view(index) in cameras else "camera"

    names = [camera.name for camera in recording.cameras]
    return {index: View(names[recording.view(index)], numbers[index], held_out(index)) for index in indices}
