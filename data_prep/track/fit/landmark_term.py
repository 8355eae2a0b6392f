"""How far the projected landmarks lie from the ones that were found, as a robust sum of squares and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.track.fit.camera import Pinhole, by_pose, to_camera
from data_prep.track.fit.chunks import chunks_of, over_chunks
from data_prep.track.fit.frame_poses import Motion
from data_prep.track.fit.normal_equations import NormalEquations
from data_prep.track.fit.surface import SurfacePoints

ROBUST, ROBUST_PAIRS = 4.0, 3.0  # scale of the loss, in units
_FRAMES_AT_ONCE = 32


@dataclass(frozen=True)
class LandmarkTerm:
    """Observations of L points in T frames, and of the vectors between P pairs of them. Distances count in `unit`.

    Each residual r adds w c^2/2 log(1 + |r|^2 / c^2) (Cauchy's loss with scale c, so that outliers count little).
    """

    landmarks: Int[np.ndarray, " L"]  # MediaPipe's numbers
    points: SurfacePoints
    camera: Pinhole
    observed: Float[Tensor, "T L 2"]  # pixels
    weights: Float[Tensor, "T L"]
    unit: Float[Tensor, " T"]  # pixels that one residual stands for: the points' standard deviation
    pairs: Int[Tensor, "P 2"]  # rows of the points
    pair_weights: Float[Tensor, "T P"]

    def take(self, frames: slice | Tensor) -> LandmarkTerm:
        """The same term of some frames."""
        names = ("observed", "weights", "unit", "pair_weights")
        return replace(self, **{name: getattr(self, name)[frames] for name in names})

    def of(self, rows: Int[Tensor, " K"]) -> LandmarkTerm:
        """The same term of some landmarks, those of all pairs among them."""
        new = torch.full((len(self.landmarks),), -1).scatter(0, rows, torch.arange(len(rows)))
        return replace(
            self,
            landmarks=self.landmarks[rows.numpy()],
            points=self.points.of(rows),
            observed=self.observed[:, rows],
            weights=self.weights[:, rows],
            pairs=new[self.pairs],
        )

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        def cost_of(chunk: slice) -> float:
            part = self.take(chunk)
            at = to_camera(motion[chunk], self.points.positions(identity, motion[chunk]))
            residuals, weights, scales = part._residuals(self.camera.project(at))
            return float((0.5 * weights * scales**2 * torch.log1p((residuals**2).sum(-1) / scales**2)).sum())

        return sum(over_chunks(cost_of, len(motion), _FRAMES_AT_ONCE))

    def errors(self, identity: Float[Tensor, " I"], motion: Motion) -> Float[Tensor, "T L"]:
        """Distances between projected and found landmarks in pixels."""
        chunks = chunks_of(len(motion), _FRAMES_AT_ONCE)
        at = [to_camera(motion[c], self.points.positions(identity, motion[c])) for c in chunks]
        return (self.camera.project(torch.cat(at)) - self.observed).norm(dim=-1)

    def add_to(self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion) -> None:
        """Add the Gauss-Newton Hessian and the gradient by a step, and by the identity where that is shared."""
        with_identity = len(equations.shared) > 0

        def rows_of(chunk: slice) -> tuple[Tensor, Tensor, Tensor | None]:
            part, moving = self.take(chunk), motion[chunk]
            placed = self.points.placed(identity, moving)
            at = to_camera(moving, placed.positions)
            slopes = self.camera.slopes(at)
            in_head = (slopes.flatten(1, 2) @ moving.R).unflatten(1, slopes.shape[1:3])  # [T, L, 2, 3]
            derivatives = self.points.derivatives(placed, in_head, with_identity)
            pose = by_pose(moving, at, slopes).permute(1, 2, 0, 3)  # [L, 2, T, 6]
            by_step = torch.cat((pose, derivatives.coefficients.unflatten(0, (-1, 2))), dim=-1)  # [L, 2, T, D]
            residuals, weights, scales = part._residuals(self.camera.project(at))
            robust = (weights / (1 + (residuals**2).sum(-1) / scales**2)).sqrt()  # [T, L + P]
            row_scale = (robust / part.unit[:, None]).T[:, None, :, None]
            J = (self._with_pairs(by_step) * row_scale).flatten(0, 1)  # [2 L + 2 P, T, D]
            r = (residuals * robust[..., None]).permute(1, 2, 0).flatten(0, 1)
            by_identity = self._with_pairs(derivatives.identity.unflatten(0, (-1, 2))) * row_scale
            return J, r, by_identity.flatten(0, 1) if with_identity else None

        equations.add_chunks(rows_of, _FRAMES_AT_ONCE)

    def _with_pairs(self, rows: Float[Tensor, "L 2 T C"]) -> Float[Tensor, "R 2 T C"]:
        return torch.cat((rows, rows[self.pairs[:, 0]] - rows[self.pairs[:, 1]]))

    def _residuals(self, projected: Float[Tensor, "T L 2"]) -> tuple[Tensor, Tensor, Tensor]:
        """In units, [T, L + P, 2]; their weights [T, L + P]; their loss's scales [L + P]."""
        off = (projected - self.observed) / self.unit[:, None, None]
        residuals = torch.cat((off, off[:, self.pairs[:, 0]] - off[:, self.pairs[:, 1]]), dim=1)
        L, P = off.shape[1], len(self.pairs)
        scales = torch.cat((off.new_full((L,), ROBUST), off.new_full((P,), ROBUST_PAIRS)))
        return residuals, torch.cat((self.weights, self.pair_weights), dim=1), scales
