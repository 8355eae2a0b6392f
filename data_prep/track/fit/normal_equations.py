"""Gauss-Newton's normal equations of a clip and their solution.

The unknowns are D numbers for each of T frames, and perhaps G that all frames share. Either frames are coupled to the two
before them (differences over time), so that the matrix is block-banded, or they share unknowns, which are its border:

    [ A  B ] [frames]     [a]        A [T D, T D] with blocks (t, t), and (t, t-1), (t, t-2) where nothing is shared
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
    before: Float[Tensor, "B D D"]  # block (t, t-1), row 0 unused; B = T, or 0 where something is shared
    before_that: Float[Tensor, "B D D"]  # block (t, t-2)
    border: Float[Tensor, "T D G"]
    shared: Float[Tensor, "G G"]
    shared_gradient: Float[Tensor, " G"]

    @staticmethod
    def zeros(frames: int, columns: int, shared: int) -> NormalEquations:
        def empty(*shape: int) -> Tensor:
            return torch.zeros(*shape, dtype=torch.float64)

        T, D, G = frames, columns, shared
        coupled = 0 if shared else frames
        return NormalEquations(
            empty(T, D, D),
            empty(T, D),
            empty(coupled, D, D),
            empty(coupled, D, D),
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


class NotPositiveDefinite(Exception):
    """The damped Hessian has no Cholesky factor: more damping is needed."""


def solve(equations: NormalEquations, damping: float) -> Step:
    """The step of Levenberg-Marquardt: every diagonal entry grows by `damping` times itself (Marquardt's scaling).

    Raises NotPositiveDefinite where that is not enough.
    """
    diagonal, shared = equations.diagonal.clone(), equations.shared.clone()
    for own in (torch.diagonal(diagonal, dim1=1, dim2=2), shared.diagonal()):
        own += damping * own
    try:
        if len(shared):
            return _with_shared(equations, diagonal, shared)
        return Step(-_banded(equations, diagonal), equations.shared_gradient)
    except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
        raise NotPositiveDefinite(str(error)) from None


def _with_shared(equations: NormalEquations, diagonal: Tensor, shared: Tensor) -> Step:
    """The step of frames that share unknowns; `diagonal` and `shared` are damped."""
    right = torch.cat((equations.gradient[..., None], equations.border), dim=2)
    solved = torch.cholesky_solve(right, torch.linalg.cholesky(diagonal))  # A^-1 [a, B]
    Ainv_a, Ainv_B = solved[..., 0], solved[..., 1:]
    schur = shared - torch.einsum("tdg,tdh->gh", equations.border, Ainv_B)
    rest = equations.shared_gradient - torch.einsum("tdg,td->g", equations.border, Ainv_a)
    by_shared = -torch.cholesky_solve(rest[:, None], torch.linalg.cholesky(schur))[:, 0]
    return Step(-Ainv_a - Ainv_B @ by_shared, by_shared)


def _banded(equations: NormalEquations, diagonal: Float[Tensor, "T D D"]) -> Float[Tensor, "T D"]:
    """A^-1 a of frames that are coupled to the two before, by the block Cholesky factor of A; `diagonal` is damped."""
    T = len(diagonal)
    own, before, before_that = (torch.zeros_like(diagonal) for _ in range(3))
    y = torch.empty_like(equations.gradient[..., None])
    for t in range(T):
        block, rest = diagonal[t], equations.gradient[t, :, None]
        if t >= 2:
            # X L' = M  ->  X: what stands left of the diagonal of the factor
            before_that[t] = _right_solve(equations.before_that[t], own[t - 2])
            block = block - before_that[t] @ before_that[t].T
            rest = rest - before_that[t] @ y[t - 2]
        if t >= 1:
            coupled = equations.before[t] - before_that[t] @ before[t - 1].T
            before[t] = _right_solve(coupled, own[t - 1])
            block = block - before[t] @ before[t].T
            rest = rest - before[t] @ y[t - 1]
        own[t] = torch.linalg.cholesky(block)
        y[t] = torch.linalg.solve_triangular(own[t], rest, upper=False)
    for t in reversed(range(T)):
        rest = y[t]
        if t + 1 < T:
            rest = rest - before[t + 1].T @ y[t + 1]
        if t + 2 < T:
            rest = rest - before_that[t + 2].T @ y[t + 2]
        y[t] = torch.linalg.solve_triangular(own[t].T, rest, upper=True)
    return y[..., 0]


def _right_solve(matrix: Tensor, factor: Tensor) -> Tensor:
    """matrix factor'^-1 of a lower triangular factor."""
    return torch.linalg.solve_triangular(factor.T, matrix, upper=True, left=False)
