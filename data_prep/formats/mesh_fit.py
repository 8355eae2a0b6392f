"""Identity of a clip and pose of each mesh, by robust least squares over vertices that correspond.

Gauss-Newton minimises, over the meshes f and their vertices n,

    sum w_n |x_fn - R_f v_n(identity, pose_f) - t_f|^2
    + sigma^2 (|identity|^2 + sum |expression_f - prior_f|^2 + |eyelids_f|^2)

with w_n = 1 / (1 + (r_n / scale)^2) of the vertex' usual residual r_n, where the scale is three times the median of these,
so that vertices which somebody moved do not count, and with the root mean square residual sigma. The poses are eliminated
from the equations of the identity (Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from avatar.head.model import nearest_rotation
from data_prep.formats.mesh_head import FIRST_EXPRESSION, FIRST_LID, HeadRows, MeshPose

LEAST_SIGMA = 1e-6  # metres: what rounding to six digits leaves
FIRST_SIGMA, LEAST_SCALE = 1e-3, 1e-4  # metres
_STEPS, _AT_REST = 12, 1e-3  # at most; radians: after smaller steps the linear equations are exact enough
_SETTLED = 0.01  # relative change of sigma
_DAMPING = 1e-9  # keeps what no vertex shows where it is


class Mesh(NamedTuple):
    points: Float[np.ndarray, "N 3"]
    prior: Float[np.ndarray, " E"] | None = None  # expression that is expected


class Identity(NamedTuple):
    """What all meshes share."""

    coefficients: Float[np.ndarray, " S"]
    weights: Float[np.ndarray, " N"]  # of the vertices, 0 to 1
    sigma: float  # metres, root mean square residual


def start(rows: HeadRows, mesh: Mesh) -> MeshPose:
    """At rest where the mesh is, with the expected expression."""
    rest = rows.at_rest()
    neutral = rows.neutral.reshape(-1, 3)
    centres = neutral.mean(axis=0), mesh.points.mean(axis=0)
    R = nearest_rotation(torch.from_numpy((mesh.points - centres[1]).T @ (neutral - centres[0]))).numpy()
    expression = rest.expression if mesh.prior is None else mesh.prior
    return rest._replace(R=R, t=centres[1] - R @ centres[0], expression=expression)


def fit_identity(mean: HeadRows, meshes: Sequence[Mesh]) -> tuple[Identity, list[MeshPose]]:
    """What the meshes share, and the pose of each. `mean` is of the mean identity."""
    S = mean.identity_dirs.shape[1]
    poses = [start(mean, mesh) for mesh in meshes]
    found = Identity(np.zeros(S), np.ones(len(mean.template)), FIRST_SIGMA)
    for _ in range(_STEPS):
        rows = mean.with_identity(found.coefficients)
        H, g = found.sigma**2 * np.eye(S), -(found.sigma**2) * found.coefficients
        eliminated = []
        for mesh, pose in zip(meshes, poses, strict=True):
            own, A, b, residual = _equations(rows, found, mesh, pose)
            by = rows.identity_derivatives(pose) * _roots(found)
            mixed = own.T @ by
            solved = np.linalg.solve(A, np.column_stack((mixed, b)))
            H += by.T @ by - mixed.T @ solved[:, :-1]
            g += by.T @ residual - mixed.T @ solved[:, -1]
            eliminated.append(solved)
        step = np.linalg.solve(H, g)
        poses = [p.moved(s[:, -1] - s[:, :-1] @ step) for p, s in zip(poses, eliminated, strict=True)]
        before, found = found, _weighed(mean, found.coefficients + step, meshes, poses)
        if abs(found.sigma - before.sigma) < _SETTLED * before.sigma or found.sigma < LEAST_SIGMA:
            break
    return found, poses


def fit_pose(rows: HeadRows, identity: Identity, mesh: Mesh, pose: MeshPose) -> tuple[MeshPose, float]:
    """The pose of a mesh from one nearby, and the root mean square residual in metres. `rows` has the identity."""
    for _ in range(_STEPS):
        _, A, b, _ = _equations(rows, identity, mesh, pose)
        step = np.linalg.solve(A, b)
        pose = pose.moved(step)
        if np.abs(step[:FIRST_LID]).max() < _AT_REST:
            break
    return pose, _mean_square(_distances(rows, mesh, pose), identity.weights)


def _roots(identity: Identity) -> np.ndarray:
    return np.sqrt(identity.weights).repeat(3)[:, None]


def _equations(
    rows: HeadRows, identity: Identity, mesh: Mesh, pose: MeshPose
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives J by the pose, the normal equations A step = b with their priors, and residuals; weighted."""
    root = _roots(identity)
    vertices, own = rows.linearised(pose)
    own *= root
    residual = (pose.inside(mesh.points) - vertices).ravel() * root[:, 0]
    prior = max(identity.sigma, LEAST_SIGMA) ** 2
    pull = np.zeros(own.shape[1])
    pull[FIRST_LID:FIRST_EXPRESSION] = -pose.eyelids
    pull[FIRST_EXPRESSION:] = (0.0 if mesh.prior is None else mesh.prior) - pose.expression
    damping = np.full(len(pull), _DAMPING)
    damping[FIRST_LID:] = prior
    return own, own.T @ own + np.diag(damping), own.T @ residual + prior * pull, residual


def _distances(rows: HeadRows, mesh: Mesh, pose: MeshPose) -> np.ndarray:
    return np.linalg.norm(pose.inside(mesh.points) - rows.vertices(pose), axis=1)


def _weighed(mean: HeadRows, coefficients: np.ndarray, meshes: Sequence[Mesh], poses: Sequence[MeshPose]) -> Identity:
    rows = mean.with_identity(coefficients)
    off = [_distances(rows, mesh, pose) for mesh, pose in zip(meshes, poses, strict=True)]
    usual = np.sqrt(np.mean(np.square(off), axis=0))
    scale = max(3 * np.median(usual), LEAST_SCALE)
    weights = 1 / (1 + (usual / scale) ** 2)
    return Identity(coefficients, weights, _mean_square(usual, weights))


def _mean_square(off: np.ndarray, weights: np.ndarray) -> float:
    return float(np.sqrt((weights * off**2).sum() / weights.sum()))
