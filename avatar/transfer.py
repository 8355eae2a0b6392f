"""Moving one person's expression onto another's avatar.

Two people's tracked coefficients differ even when both faces are at rest, because a tracker explains a part of the shape
by the expression basis. `raw` copies the coefficients and so copies that difference onto the target, which is why it looks
wrong; `relative` moves the target away from its own rest as far as the driver is away from its rest (advised by
FlashAvatar's author); `mean` does the same with the two means over time (GaussianBlendshapes' author).
Gaze and eyelids are copied as they are in every mode: zero means the same for everybody there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.model import matrix_from_6d
from avatar.types import HeadParams

Transfer = Literal["raw", "relative", "mean"]
NEUTRAL_SHARE = 0.05  # of the frames that are averaged into the neutral expression


@dataclass(frozen=True)
class RestPose:
    """The expression and jaw that a person's motion is measured from."""

    expression: Float[Tensor, " E"]
    jaw: Float[Tensor, "3 3"]  # rotation matrix
    frame: int | None  # the frame that is most like it; None for a mean


def find_neutral(motion: Sequence[HeadParams]) -> RestPose:
    """The pose that a person keeps coming back to: the densest place among the frames' expressions and jaws.

    The frame whose k nearest neighbours (k = 5% of the frames) are closest is found, and those k are averaged. A face at
    rest returns to the same place; a face in motion does not.
    """
    expression, jaw = _stacked(motion)
    features = torch.cat((expression, jaw.reshape(len(motion), 9)), dim=1)
    k = max(1, round(NEUTRAL_SHARE * len(motion)))
    distances, neighbours = torch.cdist(features, features).topk(k, dim=1, largest=False)
    densest = int(distances.mean(dim=1).argmin())
    chosen = neighbours[densest]
    return RestPose(expression[chosen].mean(dim=0), _mean_rotation(jaw[chosen]), densest)


def find_mean(motion: Sequence[HeadParams]) -> RestPose:
    """The mean over all frames."""
    expression, jaw = _stacked(motion)
    return RestPose(expression.mean(dim=0), _mean_rotation(jaw), None)


def transfer_motion(
    driver: Sequence[HeadParams], target: Sequence[HeadParams], mode: Transfer
) -> tuple[list[HeadParams], RestPose | None, RestPose | None]:
    """The driver's motion as the target's parameters, as many frames as the driver has.

    `target` holds the frames that the avatar was trained on. Returns the motion and the two rest poses that were used
    (None for `raw`). Raises ValueError when either has no frame or the expression bases differ in size.
    """
    if not driver or not target:
        raise ValueError(
            f"a transfer needs frames on both sides, got {len(driver)} of the driver, {len(target)} of the target"
        )
    sizes = len(driver[0].expression), len(target[0].expression)
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"the driver has {sizes[0]} expression coefficients, the target {sizes[1]}; they must be the same"
        )
    if mode == "raw":
        return list(driver), None, None
    find = find_neutral if mode == "relative" else find_mean
    source, goal = find(driver), find(target)
    # R = goal (source^-1 driver): the driver's rotation as seen from its rest, applied to the target's rest.
    jaw_change = goal.jaw @ source.jaw.T
    moved = [
        replace(
            params,
            expression=goal.expression + params.expression - source.expression,
            jaw=(jaw_change @ matrix_from_6d(params.jaw))[:2].reshape(6),
        )
        for params in driver
    ]
    return moved, source, goal


def _stacked(motion: Sequence[HeadParams]) -> tuple[Float[Tensor, "N E"], Float[Tensor, "N 3 3"]]:
    return (
        torch.stack([params.expression for params in motion]),
        matrix_from_6d(torch.stack([params.jaw for params in motion])),
    )


def _mean_rotation(rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation nearest to the mean matrix (chordal mean, by singular value decomposition)."""
    U, _, Vh = torch.linalg.svd(rotations.mean(dim=0))
    U = torch.cat((U[:, :2], U[:, 2:] * torch.det(U @ Vh)), dim=1)
    return U @ Vh
