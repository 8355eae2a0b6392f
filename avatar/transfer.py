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
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from torch import Tensor

from avatar.expression_space import fit_expressions
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.types import IDENTITY_6D, HeadParams

Transfer = Literal["raw", "relative", "mean", "pca"]
TRANSFERS: tuple[Transfer, ...] = ("raw", "relative", "mean", "pca")
CALM_SHARE = 0.2  # of the frames, those whose face is nearest to the generic neutral
NEUTRAL_SHARE = 0.02  # of the frames, so many are averaged into the neutral expression


@dataclass(frozen=True)
class RestPose:
    """The expression and jaw that a person's motion is measured from."""

    expression: Float[Tensor, " E"]
    jaw: Float[Tensor, "3 3"]  # rotation matrix
    frame: int | None  # the frame that is most like it; None for a mean


class Transferred(NamedTuple):
    motion: list[HeadParams]
    source: RestPose | None  # the driver's rest; None for `raw`
    goal: RestPose | None  # the target's


def find_neutral(motion: Sequence[HeadParams], head: HeadModel) -> RestPose:
    """A person's own rest: the pose that they keep coming back to while the face is calm.

    Calm are the 20% of the frames whose face is displaced least from the head model's zero expression; a talking face
    may come back more often to an open mouth, which is why density alone is not enough. Among them, the frame whose
    nearest neighbours (2% of all frames) are closest is found, and those neighbours are averaged.
    """
    expression, jaw = _stacked(motion)
    displacement = torch.stack([_face_displacement(params, head) for params in motion])
    calm = displacement.argsort()[: max(1, round(CALM_SHARE * len(motion)))]
    features = torch.cat((expression, jaw.reshape(len(motion), 9)), dim=1)[calm]
    k = min(len(calm), max(1, round(NEUTRAL_SHARE * len(motion))))
    distances, neighbours = torch.cdist(features, features).topk(k, dim=1, largest=False)
    densest = int(distances.mean(dim=1).argmin())
    chosen = calm[neighbours[densest]]
    return RestPose(expression[chosen].mean(dim=0), _mean_rotation(jaw[chosen]), int(calm[densest]))


def _face_displacement(params: HeadParams, head: HeadModel) -> Float[Tensor, ""]:
    """RMS distance in metres of the vertices from the identity at rest, gaze and blinks left out."""
    identity = torch.tensor(IDENTITY_6D)
    still = replace(params, eyes=identity.repeat(2), eyelids=torch.zeros(2), neck=identity)
    return (head.vertices(still) - head.neutral_vertices()).square().mean().sqrt()


def find_mean(motion: Sequence[HeadParams]) -> RestPose:
    """The mean over all frames."""
    expression, jaw = _stacked(motion)
    return RestPose(expression.mean(dim=0), _mean_rotation(jaw), None)


def transfer_motion(
    driver: Sequence[HeadParams],
    target: Sequence[HeadParams],
    mode: Transfer,
    driver_head: HeadModel,
    target_head: HeadModel,
    *,
    strength: float = 1.0,
) -> Transferred:
    """The driver's motion as the target's parameters, as many frames as the driver has.

    `target` holds the frames that the avatar was trained on. `strength` scales the departure from rest of expression and
    jaw: 0 is the rest itself, 1 the driver's departure; with `raw` the rest is zero. Raises ValueError when either has no
    frame or the expression bases differ in size.
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
    if mode == "raw" and strength == 1.0:
        return Transferred(list(driver), None, None)
    source = goal = None
    if mode == "mean":
        source, goal = find_mean(driver), find_mean(target)
    elif mode != "raw":
        source, goal = find_neutral(driver, driver_head), find_neutral(target, target_head)
    zero = RestPose(torch.zeros_like(driver[0].expression), torch.eye(3), None)
    moved = _moved(driver, source or zero, goal or zero, strength)
    if mode == "pca":
        moved = fit_expressions(target).nearest(moved)
    return Transferred(moved, source, goal)


def _moved(driver: Sequence[HeadParams], source: RestPose, goal: RestPose, strength: float) -> list[HeadParams]:
    """goal + strength (driver - source), and for the jaw's rotation goal (source^-1 driver)^strength."""
    expression, jaw = _stacked(driver)
    change = source.jaw.T @ jaw
    if strength != 1.0:
        change = axis_angle_to_rotation_matrix(strength * rotation_matrix_to_axis_angle(change))
    expression = goal.expression + strength * (expression - source.expression)
    jaw = (goal.jaw @ change)[:, :2].reshape(-1, 6)
    return [replace(params, expression=e, jaw=j) for params, e, j in zip(driver, expression, jaw, strict=True)]


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
