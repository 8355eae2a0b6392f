"""Chosen vertices of a FLAME-format head, and their derivatives by all that a mesh tells, in float64.

With the neck at rest only jaw and eyes turn, each about its own joint p_j, so that `HeadModel.vertices` is

    v = s + sum_j w_j (R_j - I) (s - p_j) + lids,    s = template + S identity + E expression + sum_j P_j vec(R_j - I)

and a mesh that has the head's pose inside is at R v + t.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from avatar.head.assets import HeadAssets
from avatar.head.model import JAW, LEFT_EYE, RIGHT_EYE
from data_prep.formats.root_pose import rotation_matrix

TURNING = [JAW, LEFT_EYE, RIGHT_EYE]
FIRST_LID = 6 + 3 * len(TURNING)  # before it: rotation, translation, and the turns
FIRST_EXPRESSION = FIRST_LID + 2
_GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)  # of rotations about x, y, z


class MeshPose(NamedTuple):
    """What changes from mesh to mesh."""

    R: Float[np.ndarray, "3 3"]  # from the head to the mesh
    t: Float[np.ndarray, " 3"]
    turns: Float[np.ndarray, "3 3 3"]  # jaw, left eye, right eye
    eyelids: Float[np.ndarray, " 2"]
    expression: Float[np.ndarray, " E"]

    def moved(self, step: Float[np.ndarray, " P"]) -> MeshPose:
        """By a step in the columns of `HeadRows.linearised`."""
        turns = [
            rotation_matrix(v) @ turn for v, turn in zip(step[6:FIRST_LID].reshape(-1, 3), self.turns, strict=True)
        ]
        return MeshPose(
            self.R @ rotation_matrix(step[:3]),
            self.t + self.R @ step[3:6],
            np.stack(turns),
            self.eyelids + step[FIRST_LID:FIRST_EXPRESSION],
            self.expression + step[FIRST_EXPRESSION:],
        )

    def inside(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """A mesh's points, in the head's own space."""
        return (points - self.t) @ self.R


class HeadRows:
    """The vertices `rows` of a head model, with the mean identity; its joints hang together as FLAME's do."""

    def __init__(self, head: HeadAssets, rows: Int[np.ndarray, " N"]) -> None:
        N, E = len(rows), head.num_expressions
        template, regressor = head.template.double().numpy(), head.joint_regressor.double().numpy()[TURNING]
        self.template = template[rows]
        self.identity_dirs = head.shape_dirs.numpy()[rows].astype(np.float64).reshape(3 * N, -1)
        self.expression_dirs = head.expression_dirs.numpy()[rows].astype(np.float64).reshape(3 * N, E)
        correctives = head.pose_dirs.numpy()[rows].astype(np.float64).reshape(3 * N, -1, 9)
        self.correctives = correctives[:, [joint - 1 for joint in TURNING]].reshape(3 * N, -1)
        self.weights = head.weights.double().numpy()[rows][:, TURNING]
        self.eyelid_dirs = np.ascontiguousarray(head.eyelid_dirs.double().numpy()[:, rows].reshape(2, 3 * N).T)
        self.joint_template = (regressor @ template).ravel()
        self.joint_identity_dirs = np.einsum("jv,vcs->jcs", regressor, head.shape_dirs.numpy()).reshape(9, -1)
        self.joint_expression_dirs = np.einsum("jv,vce->jce", regressor, head.expression_dirs.numpy()).reshape(9, E)
        self.neutral, self.joints = self.template.ravel(), self.joint_template

    def with_identity(self, identity: Float[np.ndarray, " S"]) -> HeadRows:
        there = copy(self)
        there.neutral = self.template.ravel() + self.identity_dirs @ identity
        there.joints = self.joint_template + self.joint_identity_dirs @ identity
        return there

    def at_rest(self) -> MeshPose:
        E = self.expression_dirs.shape[1]
        return MeshPose(np.eye(3), np.zeros(3), np.stack([np.eye(3)] * len(TURNING)), np.zeros(2), np.zeros(E))

    def vertices(self, pose: MeshPose) -> Float[np.ndarray, "N 3"]:
        """Metres, in the head's own space."""
        return self._posed(*self._shape(pose), pose)

    def linearised(self, pose: MeshPose) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "M P"]]:
        """`vertices`, and the derivatives of their M = 3 N coordinates by the P = 17 + E values of rotation, translation,
        the three turns, eyelids and expression, in the head's own space."""
        shape, from_joints, bent = self._shape(pose)
        vertices, blended = self._posed(shape, from_joints, bent, pose), self._blended(bent)
        by = np.empty((*vertices.shape, FIRST_EXPRESSION + len(pose.expression)))
        by[..., :3] = np.tensordot(vertices, _GENERATORS, (1, 2)).transpose(0, 2, 1)
        by[..., 3:6] = np.eye(3)
        for j, turn in enumerate(pose.turns):
            spin = _GENERATORS @ turn
            by_joint = np.tensordot(self.weights[:, j, None] * from_joints[:, j], spin, (1, 2)).transpose(0, 2, 1)
            by_corrective = (self.correctives[:, 9 * j : 9 * j + 9] @ spin.reshape(3, 9).T).reshape(by_joint.shape)
            by[..., 6 + 3 * j : 9 + 3 * j] = by_joint + blended @ by_corrective
        by = by.reshape(vertices.size, -1)
        by[:, FIRST_LID:FIRST_EXPRESSION] = self.eyelid_dirs
        by[:, FIRST_EXPRESSION:] = self._posed_directions(self.expression_dirs, self.joint_expression_dirs, bent)
        return vertices, by

    def identity_derivatives(self, pose: MeshPose) -> Float[np.ndarray, "M S"]:
        return self._posed_directions(self.identity_dirs, self.joint_identity_dirs, pose.turns - np.eye(3))

    def _shape(self, pose: MeshPose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s [N, 3], s - p_j [N, 3 joints, 3] and R_j - I [3 joints, 3, 3]."""
        bent = pose.turns - np.eye(3)
        shape = self.neutral + self.expression_dirs @ pose.expression + self.correctives @ bent.ravel()
        joints = self.joints + self.joint_expression_dirs @ pose.expression
        return shape.reshape(-1, 3), shape.reshape(-1, 1, 3) - joints.reshape(-1, 3), bent

    def _posed(self, shape: np.ndarray, from_joints: np.ndarray, bent: np.ndarray, pose: MeshPose) -> np.ndarray:
        by_joint = sum(self.weights[:, j, None] * (from_joints[:, j] @ turn.T) for j, turn in enumerate(bent))
        return shape + by_joint + (self.eyelid_dirs @ pose.eyelids).reshape(-1, 3)

    def _blended(self, bent: np.ndarray) -> np.ndarray:
        """I + sum_j w_j (R_j - I), [N, 3, 3]."""
        return np.eye(3) + np.tensordot(self.weights, bent, 1)

    def _posed_directions(self, directions: np.ndarray, joint_directions: np.ndarray, bent: np.ndarray) -> np.ndarray:
        """Directions [N * 3, D] of the shape, as they are after the joints' turns."""
        posed = directions.reshape(-1, 3, directions.shape[1]).copy()
        turned = self.weights.any(axis=1)
        moved = (bent @ joint_directions.reshape(len(bent), 3, -1)).reshape(len(bent), -1)
        by_joint = (self.weights[turned] @ moved).reshape(-1, *posed.shape[1:])
        posed[turned] = self._blended(bent)[turned] @ posed[turned] - by_joint
        return posed.reshape(directions.shape)
