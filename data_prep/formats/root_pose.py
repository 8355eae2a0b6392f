"""FLAME's global rotation and translation, and its neck's, moved from the head into the camera.

FLAME turns the posed head v about its root joint j and then moves it: `R_root (v - j) + j + translation`. The joint
follows identity and expression. Our world is the head without that turn, so the camera takes it:

    R = R_cam_world R_root,    t = R_cam_world (j - R_root j + translation) + t_cam_world

FLAME's neck then turns the head against the torso. Ours is the torso's turn against the head, which keeps its place, so the
camera takes the neck's rotation N about the neck joint n of the identity too: `R N` and `t + R (n - N n)`.

Source: Li et al., "Learning a model of facial shape and expression from 4D scans" (2017), eq. 2-3.
"""

from __future__ import annotations

import cv2
import numpy as np

from avatar.head.assets import HeadAssets


def rotation_matrix(axis_angle: np.ndarray) -> np.ndarray:
    """[3, 3] float64 of a rotation vector [3] in radians."""
    return cv2.Rodrigues(axis_angle.astype(np.float64))[0]


def six_d(axis_angles: np.ndarray) -> np.ndarray:
    """[K * 6]: the first two rows of the matrix of every rotation vector in [K * 3]."""
    return np.concatenate([rotation_matrix(vector)[:2].ravel() for vector in axis_angles.reshape(-1, 3)])


class Joint:
    """Where one of a head model's joints lies, in metres."""

    def __init__(self, head: HeadAssets, joint: int) -> None:
        regressor = head.joint_regressor[joint].double()
        self.num_vertices = head.num_vertices
        self._rest = (regressor @ head.template.double()).numpy()
        self._regressor = regressor.numpy()
        self._identity = np.einsum("v,vcs->cs", regressor.numpy(), head.shape_dirs.double().numpy())
        self._expression = np.einsum("v,vce->ce", regressor.numpy(), head.expression_dirs.double().numpy())

    def position(
        self, identity: np.ndarray, expression: np.ndarray | None = None, static_offset: np.ndarray | None = None
    ) -> np.ndarray:
        """[3] for coefficients of any number; those beyond the model's directions do not count.

        expression     None: at rest
        static_offset  [at least V, 3] metres, added to the vertices of the identity, where the tracker has one
        """
        expression = np.zeros(0) if expression is None else expression
        S, E = (min(a.shape[1], len(b)) for a, b in ((self._identity, identity), (self._expression, expression)))
        joint = self._rest + self._identity[:, :S] @ identity[:S] + self._expression[:, :E] @ expression[:E]
        if static_offset is not None:
            joint = joint + self._regressor @ static_offset[: self.num_vertices]
        return joint


def camera_of_head(
    R_cam_world: np.ndarray,
    t_cam_world: np.ndarray,
    root_rotation: np.ndarray,
    translation: np.ndarray,
    root_joint: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(R [3, 3], t [3]) from the head's own space to the camera, for FLAME's `root_rotation` [3, 3] and `translation`."""
    R = R_cam_world @ root_rotation
    moved = root_joint - root_rotation @ root_joint + translation
    return R, R_cam_world @ moved + t_cam_world


def turned_with_neck(
    pose: tuple[np.ndarray, np.ndarray], neck: np.ndarray, neck_joint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(R [3, 3], t [3]) of the head, for those of the torso and the neck's rotation vector [3]; the joint is at rest."""
    (R, t), N = pose, rotation_matrix(neck)
    return R @ N, t + R @ (neck_joint - N @ neck_joint)
