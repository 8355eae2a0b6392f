"""Turning the camera about the head, and how far the training video supports it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.types import Camera

EDGE = 1.0  # percent of the training frames beyond either end of a range


class Angles(NamedTuple):
    """Of the camera in the head's space, degrees."""

    yaw: float  # about the vertical axis: 0 from the front, positive from the head's own left
    elevation: float  # positive from above


class OrbitLimits(NamedTuple):
    """Degrees by which `orbited` may turn from the camera at rest, from low to high, always with 0."""

    yaw: tuple[float, float]
    pitch: tuple[float, float]


def seen_from(camera: Camera) -> Angles:
    """From where the camera sees the head."""
    x, y, z = (-camera.R_cam_world.T @ camera.t_cam_world).tolist()  # of the camera in the head's world
    return Angles(math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z))))


def orbited(camera: Camera, yaw: float = 0.0, pitch: float = 0.0, zoom: float = 1.0) -> Camera:
    """The camera after the head has been turned by `yaw` degrees about its vertical axis and by `pitch` about the sideways
    axis (positive shows more of its top); `zoom` enlarges about the middle of the picture. A camera of a rig moves around
    the head instead, which stays as it is before the reference camera.
    """
    turn = _about_x(math.radians(pitch)) @ _about_y(math.radians(yaw))
    R = camera.R_cam_world @ turn.to(camera.R_cam_world)
    middle_x, middle_y = camera.width / 2, camera.height / 2
    return replace(
        camera,
        R_cam_world=R,
        R_ref_cam=None if camera.R_ref_cam is None else camera.head_rotation @ R.T,
        fx=camera.fx * zoom,
        fy=camera.fy * zoom,
        cx=middle_x + (camera.cx - middle_x) * zoom,
        cy=middle_y + (camera.cy - middle_y) * zoom,
    )


def orbit_limits(rest: Camera, training: Sequence[Camera]) -> OrbitLimits:
    """The turns that show the head as 98% of the training frames do."""
    own = seen_from(rest)
    seen = np.array([seen_from(camera) for camera in training])
    (yaw_low, elevation_low), (yaw_high, elevation_high) = np.percentile(seen, [EDGE, 100 - EDGE], axis=0)
    # A head that turns to its left is seen from its right.
    return OrbitLimits(
        (min(float(own.yaw - yaw_high), 0.0), max(float(own.yaw - yaw_low), 0.0)),
        (min(float(elevation_low - own.elevation), 0.0), max(float(elevation_high - own.elevation), 0.0)),
    )


def _about_x(angle: float) -> Float[Tensor, "3 3"]:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle: float) -> Float[Tensor, "3 3"]:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
