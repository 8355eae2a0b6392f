"""Motion as a video, seen along a path of the camera that stays where the training video was."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from avatar.files.video import write_video
from avatar.motion.orbit import OrbitLimits, orbited
from avatar.pipeline.backdrop import Backdrop
from avatar.runs.motion_clip import Clip
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.tensors import to_8_bit
from avatar.types import Camera, HeadParams

CameraPath = Literal["recorded", "still", "swing", "orbit"]
PERIOD = 6.0  # seconds of one round


def path_camera(rest: Camera, limits: OrbitLimits, path: CameraPath, seconds: float) -> Camera:
    """Where the camera of a path is: swing from side to side, orbit around an ellipse; both within `limits`."""
    phase = 2 * math.pi * seconds / PERIOD
    middle_yaw, middle_pitch = ((high + low) / 2 for low, high in limits)
    reach_yaw, reach_pitch = ((high - low) / 2 for low, high in limits)
    if path == "swing":
        return orbited(rest, middle_yaw + reach_yaw * math.sin(phase))
    if path == "orbit":
        return orbited(rest, middle_yaw + reach_yaw * math.sin(phase), middle_pitch + reach_pitch * math.cos(phase))
    return rest


def along_path(
    trained: TrainedAvatar, clip: Clip, path: CameraPath, size: int | None = None
) -> Iterator[tuple[HeadParams, Camera]]:
    """The clip's frames with the cameras of the path; "recorded" keeps the head's pose of each frame. On others,
    which do not show it, the torso is at rest too."""
    if path == "recorded":
        yield from clip.frames
        return
    rest, limits = trained.rest_camera(size), trained.orbit_limits(trained.rest_camera())
    neck = trained.rest_params().neck
    for number, (params, _) in enumerate(clip.frames):
        yield replace(params, neck=neck), path_camera(rest, limits, path, number / clip.fps)


def write_movie(
    trained: TrainedAvatar,
    clip: Clip,
    out: Path,
    path: CameraPath,
    size: int | None = None,
    backdrop: Backdrop | None = None,
) -> None:
    """Drawn over the backdrop, else over the colour that the avatar was trained over."""
    renderings = trained.stream(along_path(trained, clip, path, size))
    if backdrop is None:
        pixels = (to_8_bit(each.image).numpy() for each in renderings)
    else:
        pixels = (backdrop.pixels(each, trained.background) for each in renderings)
    write_video(out, tqdm(pixels, total=len(clip), desc="video", unit="frame", dynamic_ncols=True), clip.fps)
