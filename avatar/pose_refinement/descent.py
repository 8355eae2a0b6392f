"""The best tracking of one frame: a few steps of a quasi-Newton method that starts with what all frames have in common.

How the picture changes with each value hardly differs between the frames of one person. So the curvature (Gauss-Newton,
J^T J) is measured on a few frames once, by drawing each with every value moved a little, and serves all frames: the first
step of a frame is a Gauss-Newton step for the price of a gradient. Corrections for the frame itself come from the
gradients along the way. With several cameras a frame is what they all saw at one time.

Source: Nocedal and Wright, "Numerical optimization" (2006), algorithm 7.4 (L-BFGS).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avatar.compute.device import on_gpu
from avatar.pose_refinement.frame_fitter import HUBER_DELTA, OBSERVATIONS, PIXEL_SIGMA, FrameFitter, Pictures, Target
from avatar.pose_refinement.parameterization import PoseParameterization
from avatar.pose_refinement.tracking_values import HeadPose

PROBE = 0.1  # units that a value is moved by to see what it does
MEMORY = 5  # steps that the frame's own curvature is learned from
SHRINK = 0.35  # of a step that made things worse
ENOUGH = 1e-3  # relative gain of a step after which the next would not show
COARSE_ENOUGH = 1e-2  # where a finer picture follows


@dataclass(frozen=True)
class Problem:
    """One time: what its cameras saw and what its tracking may become."""

    given: HeadPose
    targets: Sequence[Sequence[Target]]  # by level, full size first; a target for each picture
    row: int  # of the parameterization
    parameterization: PoseParameterization


@torch.no_grad()
def curvature(fitter: FrameFitter, problem: Problem, level: int) -> Float[Tensor, "F F"]:
    """J^T J of the misfit in the time's moves at the given tracking, pixels weighted as the Huber loss weights them."""
    targets, parameterization = problem.targets[level], problem.parameterization
    moves = torch.zeros(len(parameterization.index), device=parameterization.unit.device)

    def pictures(moves: Tensor) -> Pictures:
        return fitter.pictures(parameterization.values(problem.row, moves), problem.given, targets)

    before = pictures(moves)
    roots = []
    for picture, target in zip(before, targets, strict=True):
        error = (picture - target.picture).abs()
        roots.append(torch.where(error > HUBER_DELTA, HUBER_DELTA / error, 1.0).sqrt())
    jacobians = [picture.new_empty(len(moves), picture.numel()) for picture in before]  # transposed
    for move, probe in enumerate(PROBE * torch.eye(len(moves), dtype=torch.float64, device=moves.device)):
        probed = pictures((moves.double() + probe).to(moves.dtype))
        for jacobian, picture, still, root in zip(jacobians, probed, before, roots, strict=True):
            jacobian[move] = ((picture - still) * root).flatten() / PROBE
    found = [
        OBSERVATIONS / PIXEL_SIGMA**2 * (jacobian @ jacobian.T) / (3.0 * target.area)
        for jacobian, target in zip(jacobians, targets, strict=True)
    ]
    return torch.stack(found).sum(dim=0)


class Descent(NamedTuple):
    moves: Float[Tensor, " F"]
    pictures: Pictures  # with them, at full size


def descend(
    fitter: FrameFitter, problem: Problem, factors: Sequence[Float[Tensor, "F F"]], steps: Sequence[int]
) -> Descent:
    """The moves of a time that minimise misfit + half their squared length, within their bounds.

    factors   lower Cholesky factors of the curvature with the prior's, by level
    steps     of each level at most; the coarsest, which is the last, comes first
    """
    still = torch.zeros(len(problem.parameterization.index), device=problem.parameterization.unit.device)
    found = Descent(still, [target.picture for target in problem.targets[0]])
    for level in reversed(range(len(problem.targets))):
        found = _descend_level(fitter, problem, level, found.moves, factors[level], steps[level])
    return found


def _descend_level(
    fitter: FrameFitter, problem: Problem, level: int, moves: Tensor, factor: Tensor, steps: int
) -> Descent:
    low, high = problem.parameterization.bounds(problem.row)
    targets, unit, index = problem.targets[level], problem.parameterization.unit, problem.parameterization.index

    def evaluate(moves: Tensor) -> _Point:
        fit = fitter.fit(problem.parameterization.values(problem.row, moves), problem.given, targets)
        value = fit.misfit.double() + 0.5 * (moves @ moves).double()
        return _Point(moves, value, fit.gradient[index] * unit + moves, fit.pictures)

    decide = _Decisions(on_gpu(moves))
    memory: deque[_Curved] = deque(maxlen=MEMORY)
    best = evaluate(moves)
    length, ended = best.value.new_ones(()), torch.zeros_like(best.value, dtype=torch.bool)
    for _ in range(steps):
        direction = _quasi_newton(best.gradient, memory, factor)
        trial = evaluate(torch.minimum(torch.maximum(best.moves - length.to(direction) * direction, low), high))
        step, change = trial.moves - best.moves, trial.gradient - best.gradient
        curved = (step @ change).double() > 1e-8 * (step @ step).double()
        if decide.may(curved):
            memory.append(_Curved(step, change, curved if decide.later else None))
        better = (trial.value < best.value) & ~ended
        gain = best.value - trial.value
        length = decide.choose(better, torch.ones_like(length), length * SHRINK)
        ended = ended | (better & (gain < (COARSE_ENOUGH if level else ENOUGH) * trial.value))
        best = decide.choose_point(better, trial, best)
        if decide.is_sure(ended):
            break
    return Descent(best.moves, best.pictures)


class _Point(NamedTuple):
    moves: Float[Tensor, " F"]
    value: Float[Tensor, ""]  # float64
    gradient: Float[Tensor, " F"]
    pictures: Pictures


class _Curved(NamedTuple):
    """A step, what it changed of the gradient, and whether it counts; None: it does."""

    step: Float[Tensor, " F"]
    change: Float[Tensor, " F"]
    counts: Bool[Tensor, ""] | None


class _Decisions(NamedTuple):
    """Of numbers that are at hand, or, on a GPU, by the GPU itself when it gets there: nobody waits for it."""

    later: bool

    def may(self, condition: Bool[Tensor, ""]) -> bool:
        return self.later or bool(condition)

    def is_sure(self, condition: Bool[Tensor, ""]) -> bool:
        return not self.later and bool(condition)

    def choose(self, condition: Bool[Tensor, ""], new: Tensor, old: Tensor) -> Tensor:
        if self.later:
            return torch.where(condition, new, old)
        return new if bool(condition) else old

    def choose_point(self, condition: Bool[Tensor, ""], new: _Point, old: _Point) -> _Point:
        if not self.later:
            return new if bool(condition) else old
        pairs = zip((*new[:3], *new.pictures), (*old[:3], *old.pictures), strict=True)
        moves, value, gradient, *pictures = (torch.where(condition, *pair) for pair in pairs)
        return _Point(moves, value, gradient, pictures)


def _quasi_newton(
    gradient: Float[Tensor, " F"], memory: Sequence[_Curved], factor: Float[Tensor, "F F"]
) -> Float[Tensor, " F"]:
    """The inverse curvature times the gradient: the common curvature, scaled and corrected by the frame's own steps."""
    shares = []
    for step, change, counts in reversed(memory):
        share = (step @ gradient) / (step @ change)
        shares.append(share if counts is None else torch.where(counts, share, 0.0))
        gradient = gradient - shares[-1] * change
    direction = torch.cholesky_solve(gradient[:, None], factor)[:, 0]
    unscaled = direction
    for step, change, counts in memory if memory and memory[-1].counts is not None else list(memory)[-1:]:
        scaled = unscaled * (step @ change) / (change @ torch.cholesky_solve(change[:, None], factor)[:, 0])
        direction = scaled if counts is None else torch.where(counts, scaled, direction)
    for (step, change, counts), share in zip(memory, reversed(shares), strict=True):
        share = share - (change @ direction) / (step @ change)
        direction = direction + step * (share if counts is None else torch.where(counts, share, 0.0))
    return direction
