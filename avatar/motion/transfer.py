"""Moving one person's expression onto another's avatar.

Two people's tracked coefficients differ even when both faces are at rest, because a tracker explains a part of the shape
by the expression basis. `raw` copies the coefficients and so copies that difference onto the target, which is why it looks
wrong; `relative` moves the target away from its own rest as far as the driver is away from its rest (advised by
FlashAvatar's author); `mean` does the same with the two means over time (GaussianBlendshapes' author); `pca` is `relative`
brought to what the target has shown in training: clamped to its range along each principal component of its expressions.
Gaze and eyelids are copied as they are in every mode: zero means the same for everybody there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle

from avatar.head.model import HeadModel
from avatar.motion.neutral_pose import RestPose, find_mean, find_neutral, stacked
from avatar.motion.statistics import MotionStatistics
from avatar.types import HeadParams

Transfer = Literal["raw", "relative", "mean", "pca"]
TRANSFERS: tuple[Transfer, ...] = ("raw", "relative", "mean", "pca")
NEUTRAL_MODES: tuple[Transfer, ...] = ("relative", "pca")  # measure from neutral faces


class Transferred(NamedTuple):
    motion: list[HeadParams]
    source: RestPose | None  # the driver's rest; None for `raw`
    goal: RestPose | None  # the target's


def transfer_motion(
    driver: Sequence[HeadParams],
    target: MotionStatistics,
    mode: Transfer,
    driver_head: HeadModel,
    *,
    strength: float = 1.0,
    rest: RestPose | None = None,
) -> Transferred:
    """The driver's motion as the target's parameters, as many frames as the driver has.

    `driver_head` is the head model with the driver's identity; it finds his neutral face where that is not given as `rest`
    (`raw` and `mean` do not look at it). `strength` scales the departure from rest of expression and jaw: 0 is the rest
    itself, 1 the driver's departure; with `raw` the rest is zero. Raises ValueError when the driver has no frame or another
    number of expression coefficients.
    """
    if not driver:
        raise ValueError("a transfer needs frames of the driver, got none")
    sizes = len(driver[0].expression), len(target.neutral.expression)
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"the driver has {sizes[0]} expression coefficients, the target {sizes[1]}; they must be the same"
        )
    if mode == "raw" and strength == 1.0:
        return Transferred(list(driver), None, None)
    source = goal = None
    if mode == "mean":
        source, goal = find_mean(driver), target.mean
    elif mode in NEUTRAL_MODES:
        source, goal = rest or find_neutral(driver, driver_head), target.neutral
    zero = RestPose(torch.zeros_like(driver[0].expression), torch.eye(3), None)
    moved = retargeted(driver, source or zero, goal or zero, strength)
    if mode == "pca":
        moved = target.expressions.nearest(moved)
    return Transferred(moved, source, goal)


def retargeted(driver: Sequence[HeadParams], source: RestPose, goal: RestPose, strength: float) -> list[HeadParams]:
    """goal + strength (driver - source), and for the jaw's rotation goal (source^-1 driver)^strength."""
    expression, jaw = stacked(driver)
    change = source.jaw.T @ jaw
    if strength != 1.0:
        change = axis_angle_to_rotation_matrix(strength * rotation_matrix_to_axis_angle(change))
    expression = goal.expression + strength * (expression - source.expression)
    jaw = (goal.jaw @ change)[:, :2].reshape(-1, 6)
    return [replace(params, expression=e, jaw=j) for params, e, j in zip(driver, expression, jaw, strict=True)]
