"""Which pictures of a refined folder are of which camera and time, and how each camera sees the refined head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from avatar.data.camera_rig import CameraRig, RigCamera, parse_rig
from avatar.data.json_values import parse_value
from avatar.errors import UserError
from data_prep.formats.avatar_track import FRAMES, TRACKS_FILE
from data_prep.formats.frame_track import FrameTrack, Tracking
from data_prep.formats.tracked_folder import Shot, TrackedFolder
from data_prep.formats.train_test_split import chosen_cameras


class Pictures(NamedTuple):
    rig: CameraRig
    numbers: tuple[int, ...]  # of the pictures, as the rig has them


def parse_pictures(raw: Any) -> Pictures:
    """Raises KeyError, TypeError or ValueError."""
    numbers: tuple[int, ...] = parse_value(raw["numbers"], tuple[int, ...], "numbers")
    if list(numbers) != sorted(set(numbers)):
        raise ValueError("the numbers of the pictures do not increase")
    return Pictures(parse_rig(raw, len(numbers)), numbers)


def of_several_cameras(tracked: TrackedFolder, pictures: Pictures, cameras: str, folder: Path) -> TrackedFolder:
    """With the pictures of the chosen cameras; each has the tracking of its time, as its camera sees the head."""
    rig, times = pictures.rig, list(tracked.files.tracking)
    names = [camera.name for camera in rig.cameras]
    chosen, notes = chosen_cameras(cameras, names, lambda: names[0], folder)
    if len(times) <= max(rig.times):
        raise UserError(f"{folder / TRACKS_FILE} has {len(times)} times, fewer than its pictures; refine again")
    of = {
        number: (rig.cameras[view], times[row])
        for number, row, view in zip(pictures.numbers, rig.times, rig.views, strict=True)
        if names[view] in chosen and number in tracked.files.images
    }
    if not of:
        raise UserError(f"{folder / FRAMES} holds no picture of its cameras; refine again")

    def seen(rows: Tracking) -> Tracking:
        frames = {n: seen_by(camera, rows.frames[time]) for n, (camera, time) in of.items() if time in rows.frames}
        bad = {n: rows.bad[time] for n, (_, time) in of.items() if time in rows.bad}
        return replace(rows, frames=frames, bad=bad, paths=dict.fromkeys(of, folder / TRACKS_FILE))

    read, read_given = tracked.read, tracked.read_given
    assert read_given is not None  # what was refined was given
    kinds = {
        kind: {number: path for number, path in getattr(tracked.files, kind).items() if number in of}
        for kind in ("images", "alphas", "head_masks", "mouth_masks")
    }
    tracking = dict.fromkeys(of, folder / TRACKS_FILE)
    return replace(
        tracked,
        files=replace(tracked.files, tracking=tracking, **kinds),
        read=lambda head, size, complain: seen(read(head, size, complain)),
        read_given=lambda complain: seen(read_given(complain)),
        notes=(*tracked.notes, *notes),
        shots={number: Shot(camera.name, time) for number, (camera, time) in of.items()},
    )


def seen_by(camera: RigCamera, track: FrameTrack) -> FrameTrack:
    """The head that `track` places before the reference camera, before this one."""
    view = camera.sees(torch.from_numpy(track.R), torch.from_numpy(track.t))
    R, t = view.R_cam_world.numpy(), view.t_cam_world.numpy()
    return replace(track, R=R, t=t, intrinsics=np.array(camera.intrinsics), size=(camera.width, camera.height))
