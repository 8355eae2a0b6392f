"""What moves a head in each frame of a clip, as the fit holds it, and the local coordinates in which it is improved.

Head model parameters of T frames. The head's pose is in the camera: p_cam = R p_head + t; its neck stays at rest. A step
is a vector of D numbers a frame in the order of `Columns`: the rotation R becomes exp(step) R, everything else is added to.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

NUM_FIXED = 15  # columns before those of the expression


class Columns:
    """Where the parts of a frame's step lie."""

    ROTATION = slice(0, 3)  # radians, axes of the camera
    TRANSLATION = slice(3, 6)  # metres
    POSE = slice(0, 6)
    JAW = slice(6, 9)  # rotation vector
    GAZE = slice(9, 13)  # radians: yaw and pitch of the left eye, of the right eye
    EYELIDS = slice(13, 15)
    EXPRESSION = slice(NUM_FIXED, None)
    HEAD = slice(6, None)  # all but the pose


@dataclass(frozen=True)
class Motion:
    """T frames; float64."""

    R: Float[Tensor, "T 3 3"]
    t: Float[Tensor, "T 3"]  # metres
    jaw: Float[Tensor, "T 3"]
    gaze: Float[Tensor, "T 4"]
    eyelids: Float[Tensor, "T 2"]
    expression: Float[Tensor, "T E"]

    def __len__(self) -> int:
        return len(self.R)

    def __getitem__(self, frames: slice | Tensor) -> Motion:
        return Motion(*(getattr(self, name)[frames] for name in self.__dataclass_fields__))

    def coefficients(self) -> Float[Tensor, "T C"]:
        """All but the pose, in the order of `Columns`."""
        return torch.cat((self.jaw, self.gaze, self.eyelids, self.expression), dim=1)

    def moved(self, step: Float[Tensor, "T D"]) -> Motion:
        """The motion after a step."""
        return Motion(
            R=rotations(step[:, Columns.ROTATION]) @ self.R,
            t=self.t + step[:, Columns.TRANSLATION],
            jaw=self.jaw + step[:, Columns.JAW],
            gaze=self.gaze + step[:, Columns.GAZE],
            eyelids=self.eyelids + step[:, Columns.EYELIDS],
            expression=self.expression + step[:, Columns.EXPRESSION],
        )


def six_d(motion: Motion) -> dict[str, Float[Tensor, "T C"]]:
    """Jaw, eyes and neck as tracks and head parameters have them: the first two rows of every rotation matrix."""
    T = len(motion)
    turns = {
        "jaw": rotations(motion.jaw)[:, None],
        "eyes": gaze_rotations(motion.gaze.unflatten(1, (2, 2))),
        "neck": torch.eye(3, dtype=motion.jaw.dtype).expand(T, 1, 3, 3),
    }
    return {name: matrices[:, :, :2].reshape(T, -1) for name, matrices in turns.items()}


def at_rest(R: Float[Tensor, "T 3 3"], t: Float[Tensor, "T 3"], expressions: int) -> Motion:
    """Heads of the given poses with nothing else moved."""

    def zeros(columns: int) -> Tensor:
        return R.new_zeros(len(R), columns)

    return Motion(R, t, zeros(3), zeros(4), zeros(2), zeros(expressions))


def cross_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """The matrix that turns a vector into its cross product with v from the left."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).reshape(*v.shape, 3)


def _series(v: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of the angle a = |v|, each [*B, 1, 1], exact down to a = 0."""
    squared = (v * v).sum(-1)[..., None, None]
    is_small = squared < 1e-4  # the series' next terms are below 1e-18 there
    angle = torch.where(is_small, 1.0, squared).sqrt()
    first = torch.where(is_small, 1 - squared / 6 * (1 - squared / 20), angle.sin() / angle)
    second = torch.where(is_small, 0.5 - squared / 24 * (1 - squared / 30), (1 - angle.cos()) / angle**2)
    third = torch.where(is_small, 1 / 6 - squared / 120 * (1 - squared / 42), (angle - angle.sin()) / angle**3)
    return first, second, third


def rotations(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Rodrigues' formula: the matrices of rotation vectors in radians, differentiable at zero."""
    first, second, _ = _series(v)
    K = cross_matrix(v)
    return torch.eye(3, dtype=v.dtype) + first * K + second * (K @ K)


def left_jacobians(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """J with exp(v + d) = exp(J d) exp(v) to first order in d.

    Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eq. 145.
    """
    _, second, third = _series(v)
    K = cross_matrix(v)
    return torch.eye(3, dtype=v.dtype) + second * K + third * (K @ K)


def gaze_rotations(angles: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 3 3"]:
    """Eyes turned by (yaw to the subject's left, pitch downwards), radians, without torsion: R_y(yaw) R_x(pitch)."""
    (cy, cp), (sy, sp) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    o = torch.zeros_like(cy)
    return torch.stack((cy, sy * sp, sy * cp, o, cp, -sp, -sy, cy * sp, cy * cp), dim=-1).reshape(*cy.shape, 3, 3)


def gaze_axes(angles: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 3 2"]:
    """The axes about which the eyes turn when one of the angles changes; their unit vectors are the columns."""
    cy, sy = angles[..., 0].cos(), angles[..., 0].sin()
    o, one = torch.zeros_like(cy), torch.ones_like(cy)
    return torch.stack((o, cy, one, o, o, -sy), dim=-1).reshape(*cy.shape, 3, 2)
