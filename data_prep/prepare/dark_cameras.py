"""Cameras of a rig whose pictures are black: the avatar would learn a black side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from avatar.data.read_image import read_image
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from data_prep.formats.frame_files import ALPHA, FrameFiles
from data_prep.formats.tracked_folder import Shot
from data_prep.prepare.check_alignment import SAMPLED_OF_A_CAMERA

DARK = 0.1  # of the median camera's brightness, inside the mattes


def refuse_dark_cameras(files: FrameFiles, pairs: Sequence[tuple[int, int]], shots: Mapping[int, Shot]) -> None:
    """Raise UserError for a camera that is far darker than the others where the person is."""
    cameras = dict.fromkeys(shots[image].camera for image, _ in pairs) if shots else {}
    light = {}
    for camera in cameras:
        seen = [pair for pair in pairs if shots[pair[0]].camera == camera]
        own = evenly_spread(seen, SAMPLED_OF_A_CAMERA)
        light[camera] = float(np.median([_brightness(files, image) for image, _ in own]))
    usual = float(np.median(list(light.values()))) if light else 0.0
    for camera, own_light in light.items():
        if own_light < DARK * usual:
            raise UserError(
                f"the pictures of camera {camera} are black: {own_light:.1f} of 255 in the mean where the person is, and "
                f"{usual:.0f} by the other cameras; export it again, or leave it out with --cameras"
            )


def _brightness(files: FrameFiles, image: int) -> float:
    """Mean grey value inside the matte, 0 to 255."""
    grey = read_image(files.images[image]).mean(axis=2)
    matte = files.read(ALPHA, image)
    inside = np.ones(grey.shape, bool) if matte is None else matte > 127
    return float(grey[inside].mean()) if inside.any() else 0.0
