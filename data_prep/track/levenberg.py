"""Levenberg-Marquardt over a clip: any sum of terms, accepted when the cost falls and damped when it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.track.columns import spread
from data_prep.track.motion import Motion
from data_prep.track.normal_equations import NormalEquations, NotPositiveDefinite, solve

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-8, 1e6
CONVERGED = 1e-4  # relative decrease of the cost below which the fit has come to rest


class Term(Protocol):
    """A part of the cost. What all frames share is one of the unknowns only where the equations have shared columns."""

    def cost(self, shared: Float[Tensor, " G"], motion: Motion) -> float: ...

    def add_to(
        self, equations: NormalEquations, shared: Float[Tensor, " G"], motion: Motion, columns: Int[Tensor, " D"]
    ) -> None: ...


@dataclass(frozen=True)
class Fitted:
    shared: Float[Tensor, " G"]
    motion: Motion
    costs: tuple[float, ...]  # of the start and of every accepted step
    rejected: int


def minimise(
    terms: Sequence[Term],
    shared: Float[Tensor, " G"],
    motion: Motion,
    columns: Int[Tensor, " D"],
    iterations: int,
    with_shared: bool,
    coupled: bool,
) -> Fitted:
    """At most `iterations` steps, accepted or not, of the given columns of all frames, and of what they share if asked for."""
    damping, rejected = FIRST_DAMPING, 0
    costs = [_total(terms, shared, motion)]
    equations: NormalEquations | None = None
    for _ in range(iterations):
        if equations is None:
            equations = NormalEquations.zeros(len(motion), len(columns), len(shared) if with_shared else 0, coupled)
            for term in terms:
                term.add_to(equations, shared, motion, columns)
        try:
            step = solve(equations, damping)
        except NotPositiveDefinite:
            damping *= 10.0
            continue
        new_motion = motion.moved(spread(step.frames, columns, motion.expression.shape[1]))
        new_shared = shared + step.shared if with_shared else shared
        cost = _total(terms, new_shared, new_motion)
        if not cost < costs[-1]:  # not a number is not less
            rejected += 1
            damping *= 8.0
            if damping > MOST_DAMPING:
                break
            continue
        shared, motion, equations = new_shared, new_motion, None
        costs.append(cost)
        damping = max(damping / 4.0, LEAST_DAMPING)
        if costs[-2] - cost < CONVERGED * cost:
            break
    return Fitted(shared, motion, tuple(costs), rejected)


def _total(terms: Sequence[Term], shared: Tensor, motion: Motion) -> float:
    return sum(term.cost(shared, motion) for term in terms)


@dataclass(frozen=True)
class SharedPrior:
    """Half the squares of what all frames share, in standard deviations."""

    precision: Float[Tensor, " G"]  # 1 / variance

    def cost(self, shared: Float[Tensor, " G"], motion: Motion) -> float:  # noqa: ARG002
        return float(0.5 * (self.precision * shared**2).sum())

    def add_to(
        self,
        equations: NormalEquations,
        shared: Float[Tensor, " G"],
        motion: Motion,  # noqa: ARG002
        columns: Int[Tensor, " D"],  # noqa: ARG002
    ) -> None:
        if len(equations.shared):
            equations.shared.diagonal().add_(self.precision)
            equations.shared_gradient += self.precision * shared


def concatenated(parts: Sequence[Motion]) -> Motion:
    """Motions one after the other."""
    return Motion(*(torch.cat([getattr(part, name) for part in parts]) for name in Motion.__dataclass_fields__))
