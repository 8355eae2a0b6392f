"""Cameras around the demo person, and where the studio lies in the world of a recorded sequence.

The studio's axes are the renderer's: x right, y up, z towards the front camera, which is at the origin.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch

from avatar.demo.head import DemoHead
from avatar.demo.performance import CAMERA_DISTANCE, FIELD_OF_VIEW_HEIGHT
from avatar.types import Camera, HeadParams

AZIMUTH, ELEVATION = 60.0, 10.0  # degrees to either side of the front camera, and the most above or below it
TARGET = np.array([0.0, 0.0, -CAMERA_DISTANCE])  # what all cameras look at
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
_UP = np.array([0.0, 1.0, 0.0])


def front_camera(count: int) -> int:
    """The index of the camera that stands before the face; 8 of 16."""
    return count // 2


def studio_cameras(count: int, size: int) -> list[Camera]:
    """`count` cameras of `size` pixels a side, from the subject's right to its left. Their world is the studio; float64.

    All stand as far from the person as the camera of a single video, and have its focal length. Each has another
    principal point, off the picture's middle, and is turned so that the person is in the middle all the same.
    """
    front = front_camera(count)
    azimuths = np.concatenate((np.linspace(-AZIMUTH, 0.0, front + 1)[:-1], np.linspace(0.0, AZIMUTH, count - front)))
    elevations = ELEVATION * np.sin(_GOLDEN_ANGLE * (np.arange(count) - front))
    return [_camera(i, size, *np.radians((azimuths[i], elevations[i]))) for i in range(count)]


def _camera(index: int, size: int, azimuth: float, elevation: float) -> Camera:
    flat = np.cos(elevation)
    away = np.array([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat])
    focal = size * CAMERA_DISTANCE / FIELD_OF_VIEW_HEIGHT
    signs = np.array([1 - index // 2 % 2 * 2, 1 - index % 2 * 2])
    off_centre = signs * (0.04 + 0.02 * np.cos(np.array([2.4, 1.7]) * index)) * size
    right = np.cross(_UP, away)
    right /= np.linalg.norm(right)
    straight = np.stack((right, np.cross(-away, right), -away))
    R = _turn_from_axis(np.append(-off_centre / focal, 1.0)) @ straight
    return Camera(
        R_cam_world=torch.from_numpy(R),
        t_cam_world=torch.from_numpy(-R @ (TARGET + CAMERA_DISTANCE * away)),
        fx=focal,
        fy=focal,
        cx=size / 2 + float(off_centre[0]),
        cy=size / 2 + float(off_centre[1]),
        width=size,
        height=size,
    )


def _turn_from_axis(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation [3, 3] that takes the optical axis to `direction`."""
    direction = direction / np.linalg.norm(direction)
    across = np.cross((0.0, 0.0, 1.0), direction)
    sine = np.linalg.norm(across)
    return cv2.Rodrigues(across / sine * np.arcsin(sine))[0]


class World(NamedTuple):
    """A rigid motion from the studio to a sequence's world, float64."""

    R: np.ndarray  # [3, 3]
    t: np.ndarray  # [3] metres

    def camera_to_world(self, camera: Camera) -> np.ndarray:
        """`transform_matrix` [4, 4]: from OpenGL camera axes (y up, z backward)."""
        R_studio_cam = camera.R_cam_world.numpy().T
        matrix = np.eye(4)
        matrix[:3, :3] = self.R @ R_studio_cam @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = self.t - self.R @ R_studio_cam @ camera.t_cam_world.numpy()
        return matrix

    def root_pose(
        self, R_studio_head: np.ndarray, t_studio_head: np.ndarray, joint: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """FLAME's `rotation` [3] (axis-angle) and `translation` [3]: v -> R (v - joint) + joint + translation."""
        R = self.R @ R_studio_head
        return cv2.Rodrigues(R)[0][:, 0], self.R @ t_studio_head + self.t - joint + R @ joint


def world_of(seed: int, sequence: int) -> World:
    """The world of a person's sequence: every sequence has another one. The person is within a metre of its origin."""
    rng = np.random.default_rng((seed, 4, sequence))
    R = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
    return World(R, rng.uniform(-0.3, 0.3, 3) - R @ TARGET)


def root_joint(head: DemoHead, shape: np.ndarray, params: HeadParams) -> np.ndarray:
    """Where the root joint of a person with an expression lies, float64 [3], in the head's space."""
    identity = head.identity_dirs @ shape[: head.identity_dirs.shape[2]]
    expression = head.expression_dirs @ params.expression.numpy()[: head.expression_dirs.shape[2]]
    return head.joint_regressor[0].astype(np.float64) @ (head.template + identity + expression)
