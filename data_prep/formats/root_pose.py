"""FLAME's global rotation and translation, moved from the head into the camera.

FLAME turns the posed head v about its root joint j and then moves it: `R_root (v - j) + j + translation`. The joint
follows identity and expression. Our world is the head without that turn, so the camera takes it:

    R = R_cam_world R_root,    t = R_cam_world (j - R_root j + translation) + t_cam_world

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


class RootJoint:
    """Where a head model's root joint lies, in metres."""

    def __init__(self, head: HeadAssets) -> None:
        regressor = head.joint_regressor[0].double()
        self.num_vertices = head.num_vertices
        self._rest = (regressor @ head.template.double()).numpy()
        self._regressor = regressor.numpy()
        self._identity = np.einsum("v,vcs->cs", regressor.numpy(), head.shape_dirs.double().numpy())
        self._expression = np.einsum("v,vce->ce", regressor.numpy(), head.expression_dirs.double().numpy())

    def position(
        self, identity: np.ndarray, expression: np.ndarray, static_offset: np.ndarray | None = None
    ) -> np.ndarray:
        """[3] for coefficients of any number; those beyond the model's directions do not count.

        static_offset  [at least V, 3] metres, added to the vertices of the identity, where the tracker has one
        """
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
