"""What an avatar has been shown of its person: the rests, and the range of expressions. Other motion is measured by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from avatar.head.model import HeadModel
from avatar.motion.expression_space import ExpressionSpace, fit_expressions
from avatar.motion.neutral_pose import RestPose, find_mean, find_neutral
from avatar.types import HeadParams


@dataclass(frozen=True, repr=False)
class MotionStatistics:
    """Of the training frames."""

    neutral: RestPose
    mean: RestPose
    expressions: ExpressionSpace


def learn_statistics(
    training: Sequence[HeadParams], head: HeadModel, neutral: RestPose | None = None
) -> MotionStatistics:
    """The statistics of the frames that an avatar is trained on; `head` has their person's identity.

    The neutral face is searched for among the frames where it is not given.
    """
    return MotionStatistics(neutral or find_neutral(training, head), find_mean(training), fit_expressions(training))
