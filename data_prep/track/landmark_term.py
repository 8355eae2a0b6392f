"""How far the projected landmarks lie from the ones that were found, as a robust sum of squares and its derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.track.camera import Pinhole, by_pose, to_camera
from data_prep.track.columns import frame_columns
from data_prep.track.motion import Motion
from data_prep.track.normal_equations import NormalEquations
from data_prep.track.surface import SurfacePoints

_FRAMES_AT_ONCE = 32


@dataclass(frozen=True)
class LandmarkTerm:
    """Observations of L points in T frames, and of the vectors between P pairs of them. Distances count in `unit`.

    What all frames share are the I identity coefficients and then, for each landmark, where this person has it beside the
    point of the embedding: an offset in the head's space, metres. Each residual r adds w c^2/2 log(1 + |r|^2 / c^2)
    (Cauchy's loss with scale c, so that outliers count little).
    """

    points: SurfacePoints
    camera: Pinhole
    observed: Float[Tensor, "T L 2"]  # pixels
    weights: Float[Tensor, "T L"]
    unit: Float[Tensor, " T"]  # pixels that one residual stands for: the points' standard deviation
    pairs: Int[Tensor, "P 2"]  # rows of the points
    pair_weights: Float[Tensor, "T P"]
    scale: float  # c of the points, in units
    pair_scale: float

    def take(self, frames: slice | Tensor) -> LandmarkTerm:
        """The same term of some frames."""
        names = ("observed", "weights", "unit", "pair_weights")
        return replace(self, **{name: getattr(self, name)[frames] for name in names})

    def cost(self, shared: Float[Tensor, " G"], motion: Motion) -> float:
        total = 0.0
        for chunk in _chunks(len(motion)):
            part = self.take(chunk)
            residuals, weights, scales = part._residuals(self.camera.project(part._in_camera(shared, motion[chunk])))
            total += float((0.5 * weights * scales**2 * torch.log1p((residuals**2).sum(-1) / scales**2)).sum())
        return total

    def errors(self, shared: Float[Tensor, " G"], motion: Motion) -> Float[Tensor, "T L"]:
        """Distances between projected and found landmarks in pixels."""
        at = [self._in_camera(shared, motion[chunk]) for chunk in _chunks(len(motion))]
        return (self.camera.project(torch.cat(at)) - self.observed).norm(dim=-1)

    def add_to(
        self, equations: NormalEquations, shared: Float[Tensor, " G"], motion: Motion, columns: Int[Tensor, " D"]
    ) -> None:
        """Add the Gauss-Newton Hessian and the gradient by the given columns of a step, and by what is shared."""
        with_shared = len(equations.shared) > 0
        identity = shared[: self.points.num_identities]
        for chunk in _chunks(len(motion)):
            part, moving = self.take(chunk), motion[chunk]
            at = part._in_camera(shared, moving)
            slopes = self.camera.slopes(at)
            in_head = (slopes.flatten(1, 2) @ moving.R).unflatten(1, slopes.shape[1:3])  # [T, L, 2, 3]
            _, derivatives = self.points.positions_and_derivatives(identity, moving, in_head, with_shared)
            pose = by_pose(moving, at, slopes).permute(1, 2, 0, 3)  # [L, 2, T, 6]
            by_step = frame_columns(pose.flatten(0, 1), derivatives, columns).unflatten(0, (-1, 2))  # [L, 2, T, D]
            residuals, weights, scales = part._residuals(self.camera.project(at))
            robust = (weights / (1 + (residuals**2).sum(-1) / scales**2)).sqrt()  # [T, L + P]
            row_scale = (robust / part.unit[:, None]).T[:, None, :, None]
            J = self._with_pairs(by_step) * row_scale
            r = (residuals * robust[..., None]).permute(1, 2, 0)  # [L + P, 2, T]
            rows = J.flatten(0, 1)
            equations.diagonal[chunk] += rows.permute(1, 2, 0) @ rows.permute(1, 0, 2)
            equations.gradient[chunk] += torch.einsum("rtd,rt->td", rows, r.flatten(0, 1))
            if with_shared:
                by_identity = self._with_pairs(derivatives.identity.unflatten(0, (-1, 2))) * row_scale
                by_offset = in_head.permute(1, 2, 0, 3)  # [L, 2, T, 3]
                self._add_shared(equations, chunk, J, by_identity, by_offset, row_scale, r)

    def _add_shared(
        self,
        equations: NormalEquations,
        chunk: slice,
        J: Float[Tensor, "L+P 2 T D"],
        by_identity: Float[Tensor, "L+P 2 T I"],
        slopes: Float[Tensor, "L 2 T 3"],
        row_scale: Float[Tensor, "L+P 1 T 1"],
        r: Float[Tensor, "L+P 2 T"],
    ) -> None:
        """A residual depends on the offsets of its own landmark, or of its pair's two, only."""
        L, I = len(slopes), by_identity.shape[-1]  # noqa: E741
        whole = slice(0, I)
        S = by_identity.flatten(0, 1)
        equations.border[chunk, :, whole] += J.flatten(0, 1).permute(1, 2, 0) @ S.transpose(0, 1)
        flat = S.flatten(0, 1)
        equations.shared[whole, whole] += flat.T @ flat
        equations.shared_gradient[whole] += flat.T @ r.flatten()
        # Both ends of every residual: landmark, row, sign. A point is its own upper end and has no lower one.
        every = torch.arange(L)
        ends = [(every, every, 1.0), (self.pairs[:, 0], L + torch.arange(len(self.pairs)), 1.0)]
        ends.append((self.pairs[:, 1], L + torch.arange(len(self.pairs)), -1.0))
        T, D = J.shape[2:]
        border, shared = torch.zeros(T, D, L, 3, dtype=J.dtype), torch.zeros(L, 3, L, 3, dtype=J.dtype)
        cross, gradient = torch.zeros(I, L, 3, dtype=J.dtype), torch.zeros(L, 3, dtype=J.dtype)
        scaled = [(own, row, sign * slopes[own] * row_scale[row]) for own, row, sign in ends]  # [M, 2, T, 3]
        for own, row, O in scaled:  # noqa: E741
            border.index_add_(2, own, torch.einsum("mqtd,mqtc->tdmc", J[row], O))
            cross.index_add_(1, own, torch.einsum("mqti,mqtc->imc", by_identity[row], O))
            gradient.index_add_(0, own, torch.einsum("mqt,mqtc->mc", r[row], O))
        for own, row, O in scaled:  # noqa: E741
            for other, same_row, P in scaled:
                if len(row) == len(same_row) and torch.equal(row, same_row):
                    block = torch.einsum("mqtc,mqtd->mcd", O, P)
                    shared.permute(0, 2, 1, 3).index_put_((own, other), block, accumulate=True)
        equations.border[chunk, :, I:] += border.flatten(2)
        equations.shared[:I, I:] += cross.flatten(1)
        equations.shared[I:, :I] += cross.flatten(1).T
        equations.shared[I:, I:] += shared.flatten(2).flatten(0, 1)
        equations.shared_gradient[I:] += gradient.flatten()

    def _in_camera(self, shared: Tensor, motion: Motion) -> Float[Tensor, "T L 3"]:
        identity, offsets = shared[: self.points.num_identities], shared[self.points.num_identities :]
        return to_camera(motion, self.points.positions(identity, motion) + offsets.reshape(-1, 3))

    def _with_pairs(self, rows: Float[Tensor, "L 2 T C"]) -> Float[Tensor, "L+P 2 T C"]:
        return torch.cat((rows, rows[self.pairs[:, 0]] - rows[self.pairs[:, 1]]))

    def _residuals(self, projected: Float[Tensor, "T L 2"]) -> tuple[Tensor, Tensor, Tensor]:
        """In units, [T, L + P, 2]; their weights [T, L + P]; their loss's scales [L + P]."""
        off = (projected - self.observed) / self.unit[:, None, None]
        residuals = torch.cat((off, off[:, self.pairs[:, 0]] - off[:, self.pairs[:, 1]]), dim=1)
        L, P = off.shape[1], len(self.pairs)
        scales = torch.cat((off.new_full((L,), self.scale), off.new_full((P,), self.pair_scale)))
        return residuals, torch.cat((self.weights, self.pair_weights), dim=1), scales


def _chunks(frames: int) -> Iterator[slice]:
    for start in range(0, frames, _FRAMES_AT_ONCE):
        yield slice(start, min(start + _FRAMES_AT_ONCE, frames))
