"""The pinhole camera of a clip and the derivatives of its projection."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.track.fit.frame_poses import Motion


class Pinhole(NamedTuple):
    """Pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    def project(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 2"]:
        """Camera space, metres -> pixels."""
        x, y, z = points.unbind(-1)
        return torch.stack((self.fx * x / z + self.cx, self.fy * y / z + self.cy), dim=-1)

    def slopes(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 2 3"]:
        """Derivatives of `project` by the points."""
        x, y, z = points.unbind(-1)
        o = torch.zeros_like(z)
        rows = (self.fx / z, o, -self.fx * x / z**2, o, self.fy / z, -self.fy * y / z**2)
        return torch.stack(rows, dim=-1).reshape(*z.shape, 2, 3)


def to_camera(motion: Motion, points: Float[Tensor, "T N 3"]) -> Float[Tensor, "T N 3"]:
    """Head space -> camera space."""
    return points @ motion.R.transpose(1, 2) + motion.t[:, None]


def by_pose(
    motion: Motion, in_camera: Float[Tensor, "T N 3"], slopes: Float[Tensor, "T N Q 3"]
) -> Float[Tensor, "T N Q 6"]:
    """Derivatives of slopes . in_camera by the columns of the head's pose (see `Columns`)."""
    arm = (in_camera - motion.t[:, None])[:, :, None]  # the point turned, before it is moved
    return torch.cat((torch.linalg.cross(arm.expand_as(slopes), slopes), slopes), dim=-1)
