"""What is known of a face before its landmarks are seen: how far coefficients go, and what the blendshape scores say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.head.expression_names import ExpressionNames
from data_prep.track.faces.landmarks import BLENDSHAPES, Landmarks
from data_prep.track.fit.frame_poses import Columns, Motion
from data_prep.track.fit.normal_equations import NormalEquations

SCORE_SHARE = 0.7  # of a blendshape's score is expected in its coefficient
EXPRESSION_DEVIATION = 0.25  # of coefficients that go from 0 to 1
STATISTICAL_DEVIATION = 1.0  # of principal components, whose unit is their standard deviation
EYELID_DEVIATION = 0.25
JAW_PER_SCORE = 0.3  # radians that jawOpen = 1 stands for
JAW_DEVIATION = (0.15, 0.05, 0.03)  # radians: opening, to the sides, tilted
GAZE_DEVIATION = 0.35  # radians
# Radians between the eyes, yaw and pitch. Half of it leaves the irises no way to follow but to roll and move the head.
EYES_TIED = (0.1, 0.1)
BOX = (-0.15, 1.25)  # of coefficients that go from 0 to 1, and of eyelids
BOX_DEVIATION = 0.05  # how far outside


@dataclass(frozen=True)
class Priors:
    """Independent normal distributions of the coefficients of T frames (all columns but the pose), the box, the tie.

    Costs are half squares of deviations.
    """

    mean: Float[Tensor, "T C"]
    precision: Float[Tensor, " C"]  # 1 / variance
    low: Float[Tensor, " C"]
    high: Float[Tensor, " C"]

    def take(self, frames: slice | Tensor) -> Priors:
        return Priors(self.mean[frames], self.precision, self.low, self.high)

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        values = motion.coefficients()
        outside = values - values.clamp(self.low, self.high)
        tie = _between_eyes(motion) / torch.tensor(EYES_TIED, dtype=values.dtype)
        squares = ((values - self.mean) ** 2 * self.precision).sum() + (outside / BOX_DEVIATION).pow(2).sum()
        return float(0.5 * (squares + tie.pow(2).sum()))

    def add_to(
        self,
        equations: NormalEquations,
        identity: Float[Tensor, " I"],
        motion: Motion,
    ) -> None:
        values = motion.coefficients()
        outside = values - values.clamp(self.low, self.high)
        gradient = (values - self.mean) * self.precision + outside / BOX_DEVIATION**2
        curvature = self.precision + (outside != 0) / BOX_DEVIATION**2
        hessian = torch.diag_embed(curvature)
        between = _between_eyes(motion)
        start = Columns.GAZE.start - Columns.HEAD.start
        for axis, deviation in enumerate(EYES_TIED):
            left, right = start + axis, start + 2 + axis
            gradient[:, left] += between[:, axis] / deviation**2
            gradient[:, right] -= between[:, axis] / deviation**2
            for a, b, sign in ((left, left, 1), (right, right, 1), (left, right, -1), (right, left, -1)):
                hessian[:, a, b] += sign / deviation**2
        equations.gradient[:, Columns.HEAD] += gradient
        equations.diagonal[:, Columns.HEAD, Columns.HEAD] += hessian


def _between_eyes(motion: Motion) -> Float[Tensor, "T 2"]:
    return motion.gaze[:, :2] - motion.gaze[:, 2:]


class ScoreTarget(NamedTuple):
    """A blendshape's score that is expected in a column of the coefficients, times a weight."""

    score: str
    column: int  # from `Columns.HEAD` on
    weight: float


def _part(columns: slice) -> slice:
    """Where columns of a step lie in the coefficients."""
    first = Columns.HEAD.start
    return slice(columns.start - first, None if columns.stop is None else columns.stop - first)


def score_targets(names: ExpressionNames, expressions: Int[Tensor, " E"]) -> tuple[ScoreTarget, ...]:
    """What the scores say about the coefficients that the fit uses, numbered as in the head model."""
    jaw, lids, expression = _part(Columns.JAW), _part(Columns.EYELIDS), _part(Columns.EXPRESSION)
    found = [ScoreTarget("eyeBlinkLeft", lids.start, 1.0), ScoreTarget("eyeBlinkRight", lids.start + 1, 1.0)]
    column_of = {int(coefficient): expression.start + k for k, coefficient in enumerate(expressions)}
    jaw_is_named = False
    for blendshape in BLENDSHAPES:
        for target, weight in names.targets(blendshape).items():
            if isinstance(target, str):  # an axis of the jaw
                jaw_is_named = True
                found.append(ScoreTarget(blendshape, jaw.start + "xyz".index(target[-1]), weight))
            elif target in column_of:
                found.append(ScoreTarget(blendshape, column_of[target], SCORE_SHARE * weight))
    if not jaw_is_named:
        found.append(ScoreTarget("jawOpen", jaw.start, JAW_PER_SCORE))
    return tuple(found)


def expected(landmarks: Landmarks, targets: Sequence[ScoreTarget], expressions: int) -> Float[Tensor, "T C"]:
    """The coefficients that the scores of every frame speak for."""
    mean = np.zeros((len(landmarks), _part(Columns.EXPRESSION).start + expressions))
    for name, column, weight in targets:
        mean[:, column] += weight * landmarks.score(name).astype(np.float64)
    return torch.from_numpy(mean)


def both_ways(priors: Priors, targets: Sequence[ScoreTarget]) -> Priors:
    """With room below zero where a score stands for less, also for one that the frames have not had."""
    low = priors.low.clone()
    for _, column, weight in targets:
        if weight < 0:
            low[column].clamp_(max=-BOX[1])
    return replace(priors, low=low)


def make_priors(
    landmarks: Landmarks, names: ExpressionNames, expressions: Int[Tensor, " E"], statistical: bool
) -> Priors:
    """Priors of the frames of `landmarks` for the coefficients that the fit uses, numbered as in the head model."""
    mean = expected(landmarks, score_targets(names, expressions), len(expressions))
    C = mean.shape[1]
    deviation = torch.empty(C, dtype=torch.float64)
    low, high = torch.full((C,), -torch.inf, dtype=torch.float64), torch.full((C,), torch.inf, dtype=torch.float64)
    lids, expression = _part(Columns.EYELIDS), _part(Columns.EXPRESSION)
    deviation[_part(Columns.JAW)] = torch.tensor(JAW_DEVIATION, dtype=torch.float64)
    deviation[_part(Columns.GAZE)] = GAZE_DEVIATION
    deviation[lids] = EYELID_DEVIATION
    deviation[expression] = STATISTICAL_DEVIATION if statistical else EXPRESSION_DEVIATION
    low[lids], high[lids] = BOX
    if not statistical:
        low[expression], high[expression] = BOX
    named_negative = (mean[:, expression] < 0).any(0)  # mapped to with a negative weight: goes both ways
    low[expression] = torch.where(named_negative, low[expression].clamp(max=-BOX[1]), low[expression])
    return Priors(mean, deviation.pow(-2), low, high)
