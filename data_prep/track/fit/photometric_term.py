"""How far the colours of skin points are from what they should be, and the derivatives through the image.

A point of the head has one grey value in all frames, in each frame's light (see `texture`). Where the head is a little off,
its points land on their neighbours' values; the image's gradient says in which direction to go.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.track.fit.camera import Pinhole, by_pose, to_camera
from data_prep.track.fit.chunks import over_chunks
from data_prep.track.fit.columns import frame_columns
from data_prep.track.fit.crops import BlurredCrops
from data_prep.track.fit.motion import Motion
from data_prep.track.fit.normal_equations import NormalEquations
from data_prep.track.fit.surface import SurfacePoints

DEVIATION = 0.03  # of grey values from 0 to 1
ROBUST = 3.0  # scale of Cauchy's loss, in deviations
_FRAMES_AT_ONCE = 8


@dataclass(frozen=True)
class PhotometricTerm:
    """Of N points in T frames. The wanted values and the weights stay as they are while the motion is improved."""

    points: SurfacePoints
    camera: Pinhole
    images: BlurredCrops
    first: int  # number of the first frame in `images`
    wanted: Float[Tensor, "T N"]
    weights: Float[Tensor, "T N"]  # 0 where a point is not seen

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        def cost_of(chunk: slice) -> float:
            at = to_camera(motion[chunk], self.points.positions(identity, motion[chunk]))
            values = self.images.values(self.camera.project(at), self._frames(chunk))
            residuals = (values - self.wanted[chunk]) / DEVIATION
            robust = ROBUST**2 * torch.log1p((residuals / ROBUST) ** 2)
            return float(0.5 * (self.weights[chunk] * robust).sum())

        return sum(over_chunks(cost_of, len(motion), _FRAMES_AT_ONCE))

    def add_to(
        self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion, columns: Int[Tensor, " D"]
    ) -> None:
        with_identity = len(equations.shared) > 0

        def rows_of(chunk: slice) -> tuple[Tensor, Tensor, Tensor | None]:
            moving = motion[chunk]
            at = to_camera(moving, self.points.positions(identity, moving))
            residuals, gradient = self._residuals(self.camera.project(at), chunk)
            slopes = gradient[:, :, None] @ self.camera.slopes(at)  # [T, N, 1, 3]
            robust = (self.weights[chunk] / (1 + (residuals / ROBUST) ** 2)).sqrt()
            slopes = slopes * robust[..., None, None]
            in_head = (slopes.flatten(1, 2) @ moving.R)[:, :, None]
            _, derivatives = self.points.positions_and_derivatives(identity, moving, in_head, with_identity)
            pose = by_pose(moving, at, slopes)[:, :, 0].transpose(0, 1)  # [N, T, 6]
            J = frame_columns(pose, derivatives, columns)
            return J, (residuals * robust).T, derivatives.identity if with_identity else None

        equations.add_chunks(rows_of, _FRAMES_AT_ONCE)

    def _residuals(self, pixels: Float[Tensor, "T N 2"], chunk: slice) -> tuple[Tensor, Tensor]:
        """In deviations [T, N], and their derivatives by the pixels [T, N, 2]."""
        values, gradient = self.images.sample(pixels, self._frames(chunk))
        return (values - self.wanted[chunk]) / DEVIATION, gradient / DEVIATION

    def _frames(self, chunk: slice) -> slice:
        """Where the images of a chunk are."""
        return slice(self.first + chunk.start, self.first + chunk.stop)
