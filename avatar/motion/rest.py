"""A person's rest: the expression and jaw that their motion is measured from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.model import HeadModel, matrix_from_6d
from avatar.types import IDENTITY_6D, HeadParams

CALM_SHARE = 0.2  # of the frames, those whose face is nearest to the generic neutral
NEUTRAL_SHARE = 0.02  # of the frames, so many are averaged into the neutral expression


@dataclass(frozen=True)
class RestPose:
    """The expression and jaw that a person's motion is measured from."""

    expression: Float[Tensor, " E"]
    jaw: Float[Tensor, "3 3"]  # rotation matrix
    frame: int | None  # the frame that is most like it; None for a mean


def find_neutral(motion: Sequence[HeadParams], head: HeadModel) -> RestPose:
    """A person's own rest: the pose that they keep coming back to while the face is calm.

    Calm are the 20% of the frames whose face is displaced least from the head model's zero expression; a talking face
    may come back more often to an open mouth, which is why density alone is not enough. Among them, the frame whose
    nearest neighbours (2% of all frames) are closest is found, and those neighbours are averaged.
    """
    expression, jaw = stacked(motion)
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
    expression, jaw = stacked(motion)
    return RestPose(expression.mean(dim=0), _mean_rotation(jaw), None)


def stacked(motion: Sequence[HeadParams]) -> tuple[Float[Tensor, "N E"], Float[Tensor, "N 3 3"]]:
    """Expressions and jaw rotations of N frames."""
    return (
        torch.stack([params.expression for params in motion]),
        matrix_from_6d(torch.stack([params.jaw for params in motion])),
    )


def _mean_rotation(rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation nearest to the mean matrix (chordal mean, by singular value decomposition)."""
    U, _, Vh = torch.linalg.svd(rotations.mean(dim=0))
    U = torch.cat((U[:, :2], U[:, 2:] * torch.det(U @ Vh)), dim=1)
    return U @ Vh
