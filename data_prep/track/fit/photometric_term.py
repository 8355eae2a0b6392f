"""How far the colours of skin points are from what they should be, and the derivatives through the image.

A point of the head has one grey value in all frames, in each frame's light (see `texture`). Where the head is a little off,
its points land on their neighbours' values; the image's gradient says in which direction to go.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.track.fit.camera import Pinhole, by_pose, to_camera
from data_prep.track.fit.chunks import over_chunks
from data_prep.track.fit.crops import BlurredCrops
from data_prep.track.fit.frame_poses import Motion
from data_prep.track.fit.normal_equations import NormalEquations
from data_prep.track.fit.surface import SurfacePoints

DEVIATION = 0.03  # of grey values from 0 to 1
ROBUST = 3.0  # scale of Cauchy's loss, in deviations
_FRAMES_AT_ONCE = 16


class SkinValues:
    """What T frames show of N points. The last values are kept: a step begins where the one before ended."""

    def __init__(self, points: SurfacePoints, camera: Pinhole, images: BlurredCrops) -> None:
        self.points, self.camera, self.images = points, camera, images
        self._kept: tuple[Tensor, Motion, Tensor] | None = None

    def at(self, identity: Float[Tensor, " I"], motion: Motion) -> Float[Tensor, "T N"]:
        if self._kept is not None and self._kept[0] is identity and self._kept[1] is motion:
            return self._kept[2]

        def of(chunk: slice) -> Tensor:
            at = to_camera(motion[chunk], self.points.positions(identity, motion[chunk]))
            return self.images.values(self.camera.project(at), chunk)

        values = torch.cat(over_chunks(of, len(motion), _FRAMES_AT_ONCE))
        self._kept = identity, motion, values
        return values


@dataclass(frozen=True)
class PhotometricTerm:
    """Of N points in T frames. The wanted values and the weights stay as they are while the motion is improved."""

    seen: SkinValues
    wanted: Float[Tensor, "T N"]
    weights: Float[Tensor, "T N"]  # 0 where a point is not seen

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        residuals = (self.seen.at(identity, motion) - self.wanted) / DEVIATION
        robust = ROBUST**2 * torch.log1p((residuals / ROBUST) ** 2)
        return float(0.5 * (self.weights * robust).sum())

    def add_to(self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion) -> None:
        """Add the Gauss-Newton Hessian and the gradient by a step; the identity is given."""
        seen = self.seen

        def rows_of(chunk: slice) -> tuple[Tensor, Tensor, None]:
            moving = motion[chunk]
            placed = seen.points.placed(identity, moving)
            at = to_camera(moving, placed.positions)
            values, gradient = seen.images.sample(seen.camera.project(at), chunk)
            residuals = (values - self.wanted[chunk]) / DEVIATION
            slopes = gradient[:, :, None] / DEVIATION @ seen.camera.slopes(at)  # [T, N, 1, 3]
            robust = (self.weights[chunk] / (1 + (residuals / ROBUST) ** 2)).sqrt()
            slopes = slopes * robust[..., None, None]
            in_head = (slopes.flatten(1, 2) @ moving.R)[:, :, None]
            derivatives = seen.points.derivatives(placed, in_head)
            pose = by_pose(moving, at, slopes)[:, :, 0].transpose(0, 1)  # [N, T, 6]
            return torch.cat((pose, derivatives.coefficients), dim=-1), (residuals * robust).T, None

        equations.add_chunks(rows_of, _FRAMES_AT_ONCE)
