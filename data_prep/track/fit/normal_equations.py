"""Gauss-Newton's normal equations of a clip and their solution.

The unknowns are D numbers for each of T frames and G that all frames share. Frames are coupled to the two before them
(differences over time), so the matrix is block-banded with a border:

    [ A  B ] [frames]     [a]        A [T D, T D] with blocks (t, t), (t, t-1), (t, t-2)
    [ B' C ] [shared] = - [c]

A is factorised by blocks (Cholesky), the border by its Schur complement C - B' A^-1 B: time grows with T, not T^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.track.fit.chunks import chunks_of, over_chunks

Rows = tuple[Float[Tensor, "R T D"], Float[Tensor, "R T"], Float[Tensor, "R T H"] | None]
"""Derivatives of R residuals of some frames, the residuals, and the derivatives by the first H shared unknowns."""


@dataclass
class NormalEquations:
    """Hessian and gradient of a cost; float64. Terms add themselves in."""

    diagonal: Float[Tensor, "T D D"]
    gradient: Float[Tensor, "T D"]
    before: Float[Tensor, "T D D"] | None  # block (t, t-1), row 0 unused; None where frames are not coupled
    before_that: Float[Tensor, "T D D"] | None  # block (t, t-2)
    border: Float[Tensor, "T D G"]
    shared: Float[Tensor, "G G"]
    shared_gradient: Float[Tensor, " G"]

    @staticmethod
    def zeros(frames: int, columns: int, shared: int, coupled: bool) -> NormalEquations:
        def empty(*shape: int) -> Tensor:
            return torch.zeros(*shape, dtype=torch.float64)

        T, D, G = frames, columns, shared
        return NormalEquations(
            empty(T, D, D),
            empty(T, D),
            empty(T, D, D) if coupled else None,
            empty(T, D, D) if coupled else None,
            empty(T, D, G),
            empty(G, G),
            empty(G),
        )

    def add_chunks(self, rows_of: Callable[[slice], Rows], at_once: int) -> None:
        """Add the rows of all frames, `at_once` frames at a time. Where nothing is shared, chunks are made side by side."""
        if len(self.shared):  # sums over frames must not depend on who comes first
            for chunk in chunks_of(len(self.gradient), at_once):
                self.add_rows(chunk, *rows_of(chunk))
        else:
            over_chunks(lambda chunk: self.add_rows(chunk, *rows_of(chunk)), len(self.gradient), at_once)

    def add_rows(
        self,
        frames: slice,
        rows: Float[Tensor, "R T D"],
        residuals: Float[Tensor, "R T"],
        shared: Float[Tensor, "R T H"] | None,
    ) -> None:
        """Add R residuals of each of some frames with their derivatives; `shared` by the first H shared unknowns."""
        by_frame = rows.permute(1, 2, 0)
        self.diagonal[frames] += by_frame @ rows.transpose(0, 1)
        self.gradient[frames] += torch.einsum("rtd,rt->td", rows, residuals)
        if shared is not None:
            own = slice(0, shared.shape[-1])
            self.border[frames, :, own] += by_frame @ shared.transpose(0, 1)
            flat = shared.flatten(0, 1)
            self.shared[own, own] += flat.T @ flat
            self.shared_gradient[own] += flat.T @ residuals.flatten()


@dataclass(frozen=True)
class Step:
    frames: Float[Tensor, "T D"]
    shared: Float[Tensor, " G"]
    decrease: float  # of the cost, that the quadratic model promises


class NotPositiveDefinite(Exception):
    """The damped Hessian has no Cholesky factor: more damping is needed."""


def solve(equations: NormalEquations, damping: float) -> Step:
    """The step of Levenberg-Marquardt: every diagonal entry grows by `damping` times itself (Marquardt's scaling).

    Raises NotPositiveDefinite where that is not enough.
    """
    diagonal = equations.diagonal.clone()
    own = torch.diagonal(diagonal, dim1=1, dim2=2)
    own += damping * own
    shared = equations.shared.clone()
    shared.diagonal().add_(damping * equations.shared.diagonal())
    try:
        factors = _Factors(diagonal, equations.before, equations.before_that)
        right = torch.cat((equations.gradient[..., None], equations.border), dim=2)
        solved = factors.solve(right)  # A^-1 [a, B]
        Ainv_a, Ainv_B = solved[..., 0], solved[..., 1:]
        G = len(shared)
        schur = shared - torch.einsum("tdg,tdh->gh", equations.border, Ainv_B)
        rest = equations.shared_gradient - torch.einsum("tdg,td->g", equations.border, Ainv_a)
        by_shared = -torch.cholesky_solve(rest[:, None], torch.linalg.cholesky(schur))[:, 0] if G else rest
    except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
        raise NotPositiveDefinite(str(error)) from None
    by_frames = -Ainv_a - Ainv_B @ by_shared
    # Of 1/2 x' H x + g' x with the damped H: half of -g' x at its minimum; the undamped model promises more.
    linear = float((equations.gradient * by_frames).sum() + equations.shared_gradient @ by_shared)
    return Step(by_frames, by_shared, -0.5 * linear)


class _Factors:
    """The block Cholesky factor of a block-banded matrix."""

    def __init__(self, diagonal: Tensor, before: Tensor | None, before_that: Tensor | None) -> None:
        if before is None or before_that is None:
            self._own, self._before, self._before_that = torch.linalg.cholesky(diagonal), None, None
            return
        T = len(diagonal)
        self._own = torch.empty_like(diagonal)
        self._before, self._before_that = torch.zeros_like(before), torch.zeros_like(before_that)
        for t in range(T):
            block = diagonal[t]
            if t >= 2:
                # X L' = M  ->  X: what stands left of the diagonal of the factor
                self._before_that[t] = _right_solve(before_that[t], self._own[t - 2])
                block = block - self._before_that[t] @ self._before_that[t].T
            if t >= 1:
                coupled = before[t] - self._before_that[t] @ self._before[t - 1].T
                self._before[t] = _right_solve(coupled, self._own[t - 1])
                block = block - self._before[t] @ self._before[t].T
            self._own[t] = torch.linalg.cholesky(block)

    def solve(self, right: Float[Tensor, "T D K"]) -> Float[Tensor, "T D K"]:
        if self._before is None or self._before_that is None:
            return torch.cholesky_solve(right, self._own)
        T = len(right)
        y = torch.empty_like(right)
        for t in range(T):
            rest = right[t]
            if t >= 1:
                rest = rest - self._before[t] @ y[t - 1]
            if t >= 2:
                rest = rest - self._before_that[t] @ y[t - 2]
            y[t] = torch.linalg.solve_triangular(self._own[t], rest, upper=False)
        for t in reversed(range(T)):
            rest = y[t]
            if t + 1 < T:
                rest = rest - self._before[t + 1].T @ y[t + 1]
            if t + 2 < T:
                rest = rest - self._before_that[t + 2].T @ y[t + 2]
            y[t] = torch.linalg.solve_triangular(self._own[t].T, rest, upper=True)
        return y


def _right_solve(matrix: Tensor, factor: Tensor) -> Tensor:
    """matrix factor'^-1 of a lower triangular factor."""
    return torch.linalg.solve_triangular(factor.T, matrix, upper=True, left=False)
