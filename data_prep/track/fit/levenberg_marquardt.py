"""Levenberg-Marquardt over a clip: any sum of terms, accepted when the cost falls and damped when it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.track.fit.frame_poses import NUM_FIXED, Motion
from data_prep.track.fit.normal_equations import NormalEquations, NotPositiveDefinite, solve

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-8, 1e6
CONVERGED = 1e-4  # relative decrease of the cost below which the fit has come to rest


class Term(Protocol):
    """A part of the cost. The identity is one of the unknowns only where the equations have shared columns."""

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float: ...

    def add_to(self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion) -> None: ...


@dataclass(frozen=True)
class Fitted:
    identity: Float[Tensor, " I"]
    motion: Motion


def minimise(
    terms: Sequence[Term],
    identity: Float[Tensor, " I"],
    motion: Motion,
    iterations: int,
    with_identity: bool = False,
) -> Fitted:
    """At most `iterations` steps, accepted or not, of all frames, and of the identity if asked for.

    With the identity, no term may tie frames to each other.
    """
    damping, least = FIRST_DAMPING, _total(terms, identity, motion)
    equations: NormalEquations | None = None
    for _ in range(iterations):
        if equations is None:
            equations = NormalEquations.zeros(
                len(motion), NUM_FIXED + motion.expression.shape[1], len(identity) if with_identity else 0
            )
            for term in terms:
                term.add_to(equations, identity, motion)
        try:
            step = solve(equations, damping)
        except NotPositiveDefinite:
            damping *= 10.0
            continue
        new_motion = motion.moved(step.frames)
        new_identity = identity + step.shared if with_identity else identity
        cost = _total(terms, new_identity, new_motion)
        if not cost < least:  # not a number is not less
            damping *= 8.0
            if damping > MOST_DAMPING:
                break
            continue
        identity, motion, equations = new_identity, new_motion, None
        damping = max(damping / 4.0, LEAST_DAMPING)
        least, before = cost, least
        if before - cost < CONVERGED * cost:
            break
    return Fitted(identity, motion)


def _total(terms: Sequence[Term], identity: Tensor, motion: Motion) -> float:
    return sum(term.cost(identity, motion) for term in terms)


@dataclass(frozen=True)
class IdentityPrior:
    """Half the squares of the identity coefficients, whose unit is their standard deviation, times `weight`."""

    weight: float

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        return float(0.5 * self.weight * (identity @ identity))

    def add_to(self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion) -> None:
        if len(equations.shared):
            equations.shared.diagonal().add_(self.weight)
            equations.shared_gradient += self.weight * identity


def concatenated(parts: Sequence[Motion]) -> Motion:
    """Motions one after the other."""
    return Motion(*(torch.cat([getattr(part, name) for part in parts]) for name in Motion.__dataclass_fields__))
