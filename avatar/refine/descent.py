"""The best tracking of one frame: a few steps of a quasi-Newton method that starts with what all frames have in common.

How the picture changes with each value hardly differs between the frames of one person. So the curvature (Gauss-Newton,
J^T J) is measured on a few frames once, by drawing each with every value moved a little, and serves all frames: the first
step of a frame is a Gauss-Newton step for the price of a gradient. Corrections for the frame itself come from the
gradients along the way. Source: Nocedal and Wright, "Numerical optimization" (2006), algorithm 7.4 (L-BFGS).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.refine.freedom import Freedom
from avatar.refine.likeness import HUBER_DELTA, OBSERVATIONS, PIXEL_SIGMA, Likeness, Target
from avatar.refine.motion import HeadPose

PROBE = 0.1  # units that a value is moved by to see what it does
MEMORY = 5  # steps that the frame's own curvature is learned from
SHRINK = 0.35  # of a step that made things worse
ENOUGH = 1e-3  # relative gain of a step after which the next would not show
COARSE_ENOUGH = 1e-2  # where a finer picture follows


@dataclass(frozen=True)
class Problem:
    """One frame: what it shows and what its tracking may become."""

    given: HeadPose
    targets: Sequence[Target]  # by level, full size first
    frame: int  # of the freedom
    freedom: Freedom


@torch.no_grad()
def curvature(likeness: Likeness, problem: Problem, level: int) -> Float[Tensor, "F F"]:
    """J^T J of the misfit in the frame's moves at the given tracking, each pixel weighted as the Huber loss weights it."""
    target, freedom = problem.targets[level], problem.freedom
    moves = torch.zeros(len(freedom.index))

    def picture(moves: Tensor) -> Tensor:
        return likeness.picture(freedom.values(problem.frame, moves), problem.given, target)

    still = picture(moves)
    error = (still - target.picture).abs()
    weight = torch.where(error > HUBER_DELTA, HUBER_DELTA / error, 1.0).sqrt()
    columns = []
    for k in range(len(moves)):
        moves[k] = PROBE
        columns.append(((picture(moves) - still) * weight).flatten() / PROBE)
        moves[k] = 0.0
    jacobian = torch.stack(columns, dim=1)
    return OBSERVATIONS / PIXEL_SIGMA**2 * (jacobian.T @ jacobian) / (3.0 * target.area)


class Descent(NamedTuple):
    moves: Float[Tensor, " F"]
    picture: Float[Tensor, "h w 3"]  # with them, at full size


def descend(
    likeness: Likeness, problem: Problem, factors: Sequence[Float[Tensor, "F F"]], steps: Sequence[int]
) -> Descent:
    """The moves of a frame that minimise misfit + half their squared length, within their bounds.

    factors   lower Cholesky factors of the curvature with the prior's, by level
    steps     of each level at most; the coarsest, which is the last, comes first
    """
    found = Descent(torch.zeros(len(problem.freedom.index)), problem.targets[0].picture)
    for level in reversed(range(len(problem.targets))):
        found = _descend_level(likeness, problem, level, found.moves, factors[level], steps[level])
    return found


def _descend_level(
    likeness: Likeness, problem: Problem, level: int, moves: Tensor, factor: Tensor, steps: int
) -> Descent:
    low, high = problem.freedom.bounds(problem.frame)
    target, unit, index = problem.targets[level], problem.freedom.unit, problem.freedom.index

    def evaluate(moves: Tensor) -> tuple[float, Tensor, Tensor]:
        fit = likeness.fit(problem.freedom.values(problem.frame, moves), problem.given, target)
        return fit.misfit + 0.5 * float(moves @ moves), fit.gradient[index] * unit + moves, fit.picture

    memory: deque[tuple[Tensor, Tensor]] = deque(maxlen=MEMORY)
    value, gradient, picture = evaluate(moves)
    length = 1.0
    for _ in range(steps):
        trial = torch.minimum(torch.maximum(moves - length * _quasi_newton(gradient, memory, factor), low), high)
        new_value, new_gradient, new_picture = evaluate(trial)
        step, change = trial - moves, new_gradient - gradient
        if float(step @ change) > 1e-8 * float(step @ step):
            memory.append((step, change))
        if not new_value < value:
            length *= SHRINK
            continue
        gain = value - new_value
        moves, value, gradient, picture, length = trial, new_value, new_gradient, new_picture, 1.0
        if gain < (COARSE_ENOUGH if level else ENOUGH) * new_value:
            break
    return Descent(moves, picture)


def _quasi_newton(
    gradient: Float[Tensor, " F"], memory: Sequence[tuple[Tensor, Tensor]], factor: Float[Tensor, "F F"]
) -> Float[Tensor, " F"]:
    """The inverse curvature times the gradient: the common curvature, scaled and corrected by the frame's own steps."""
    shares = []
    for step, change in reversed(memory):
        share = (step @ gradient) / (step @ change)
        shares.append(share)
        gradient = gradient - share * change
    direction = torch.cholesky_solve(gradient[:, None], factor)[:, 0]
    if memory:
        step, change = memory[-1]
        direction = direction * (step @ change) / (change @ torch.cholesky_solve(change[:, None], factor)[:, 0])
    for (step, change), share in zip(memory, reversed(shares), strict=True):
        direction = direction + step * (share - (change @ direction) / (step @ change))
    return direction
