"""Gaussians that keep with the skull in place of the skin that they are bound to, each by a share that is learned.

A FLAME-format mesh is skin and eyeballs. Glasses, hair and the upper teeth are drawn by Gaussians of the skin beside them,
but do not move with it. With w = sigmoid(logit) of each Gaussian, learned like its opacity, its place is

    point = (1 - w) * (its point on the posed mesh) + w * (its point on the skull)

before the network's offset. The skull is the identity at rest, whose torso the neck turns beneath it: expression, jaw, eyes
and eyelids do not move it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import to_device
from avatar.gaussians.mesh_embedding import Embedding
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.types import IDENTITY_6D

INITIAL_LOGIT = -2.0  # 12 % of the skull: enough of its gradient to find out


@dataclass
class Skull:
    """Where the points of an embedding are on the skull; not a parameter."""

    at_rest: Float[Tensor, "N 3"]  # metres
    arms: Float[Tensor, "N 3"]  # what is torso, from the neck's joint, metres: a neck R moves a point by (R^T - 1) arm

    @staticmethod
    def of(head: HeadModel, embedding: Embedding) -> Skull:
        joint, shares = head.neck()
        neutral = head.neutral_vertices()
        return Skull(embedding.points(neutral), embedding.points((1 - shares[:, None]) * (neutral - joint)))

    def points(self, neck: Float[Tensor, " 6"]) -> Float[Tensor, "N 3"]:
        """On the skull above the torso that `neck`, a 6D rotation, turns; metres. Differentiable; reads nothing back."""
        device = self.at_rest.device
        if neck.is_cpu and not neck.requires_grad and tuple(neck.tolist()) == IDENTITY_6D:
            return self.at_rest
        turn = matrix_from_6d(to_device(neck, device).to(self.at_rest.dtype)) - torch.eye(3, device=device)
        return torch.addmm(self.at_rest, self.arms, turn)

    def move(self, device: torch.device) -> None:
        if self.arms.device != device:
            self.at_rest, self.arms = self.at_rest.to(device), self.arms.to(device)


class SkullBinding(NamedTuple):
    """What holds points in a frame."""

    skull: Skull
    neck: Float[Tensor, " 6"]
    logits: Float[Tensor, " N"]  # of the shares that keep with the skull


def bind_to_skull(points: Float[Tensor, "N 3"], by: SkullBinding | None) -> Float[Tensor, "N 3"]:
    """`points` of the posed mesh, each brought to the skull by its share. Differentiable."""
    if by is None:
        return points
    return torch.lerp(points, by.skull.points(by.neck), torch.sigmoid(by.logits)[:, None])
