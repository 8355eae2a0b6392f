"""Gaussians that keep with the skull in place of the skin that they are bound to, each by a share that is learned.

A FLAME-format mesh is skin and eyeballs. Glasses, hair and the upper teeth are drawn by Gaussians of the skin beside them,
but do not move with it. With w = sigmoid(logit) of each Gaussian, learned like its opacity, its place is

    point = (1 - w) * (its point on the posed mesh) + w * (its point on the skull)

before the network's offset. The skull is the identity at rest: expression, jaw, eyes, eyelids and the torso, which the neck
turns against the head, do not move it. So on the neck the share is that of the head, and the rest is the torso's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

INITIAL_LOGIT = -2.0  # 12 % of the skull: enough of its gradient to find out


class SkullBinding(NamedTuple):
    """What holds points in a frame."""

    skull: Float[Tensor, "N 3"]  # where they are on the identity at rest, metres
    logits: Float[Tensor, " N"]  # of the shares that keep with the skull


def bind_to_skull(points: Float[Tensor, "N 3"], by: SkullBinding | None) -> Float[Tensor, "N 3"]:
    """`points` of the posed mesh, each brought to the skull by its share. Differentiable."""
    return points if by is None else torch.lerp(points, by.skull, torch.sigmoid(by.logits)[:, None])
