"""Head pose over time, in the terms that people think in: angles, distances and how suddenly they change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_prep.formats.frame_track import FrameTrack


@dataclass(frozen=True)
class HeadAngles:
    """Degrees, [n] each; all zero for a head that faces the camera upright."""

    yaw: np.ndarray  # positive: turned to the image's right
    pitch: np.ndarray  # positive: looking up
    roll: np.ndarray  # positive: the crown tilts to the image's right


def head_angles(rotations: np.ndarray) -> HeadAngles:
    """From world-to-camera rotations [n, 3, 3]: FLAME's head looks along +z with y up, an OpenCV camera sees y down."""
    forward, up = rotations[:, :, 2], rotations[:, :, 1]
    yaw = np.arctan2(forward[:, 0], -forward[:, 2])
    pitch = np.arctan2(-forward[:, 1], np.hypot(forward[:, 0], forward[:, 2]))
    roll = np.arctan2(up[:, 0], -up[:, 1])
    return HeadAngles(np.degrees(yaw), np.degrees(pitch), np.degrees(roll))


@dataclass(frozen=True)
class Jumps:
    """How far each frame lies from half-way between its neighbours; NaN at the ends and beside missing numbers."""

    rotation: np.ndarray  # [n] degrees
    translation: np.ndarray  # [n] mm
    expression: np.ndarray  # [n] norm over the coefficients


def measure_jumps(numbers: Sequence[int], tracks: Sequence[FrameTrack]) -> Jumps:
    rotations, translations, expressions = (
        np.array([getattr(track, name) for track in tracks]).reshape(len(tracks), *shape)
        for name, shape in (("R", (3, 3)), ("t", (3,)), ("expression", (-1,)))
    )
    result = np.full((3, len(tracks)), np.nan)
    if len(tracks) >= 3:
        n = np.array(numbers)
        consecutive = (n[1:-1] - n[:-2] == 1) & (n[2:] - n[1:-1] == 1)
        U, _, Vt = np.linalg.svd(rotations[:-2] + rotations[2:])  # the mean of two rotations: project their sum
        between = rotations[1:-1] @ (U @ Vt).transpose(0, 2, 1)
        cosine = np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)
        result[0, 1:-1] = np.where(consecutive, np.degrees(np.arccos(cosine)), np.nan)
        for row, values, unit in ((1, translations, 1000.0), (2, expressions, 1.0)):
            middle = values[1:-1] - (values[:-2] + values[2:]) / 2
            result[row, 1:-1] = np.where(consecutive, unit * np.linalg.norm(middle, axis=1), np.nan)
    return Jumps(*result)
