"""The networks that move, colour and change the Gaussians: one set follows the expression, another the head's pose.

Near the face's landmarks the expression's networks decide, far from them the pose's, in between both:

    output = near * expression_network + (1 - near) * pose_network

Source: Xu et al., Gaussian Head Avatar (CVPR 2024), section 3.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from avatar.gaussians.encoding import encoded_size, positional_encoding

OCTAVES = 4
SLOPE = 0.01  # of the leaky ReLU below 0
ATTRIBUTES = 8  # scale 3, rotation 4, opacity 1
CHUNK = 2048  # points whose distances to all landmarks are computed at a time, in the cache


class PointNetwork(nn.Module):
    """Linear layers of the sizes `dims` with leaky ReLU; the input is concatenated again before layer len(dims) // 2."""

    def __init__(self, dims: tuple[int, ...], last: Literal["tanh"] | None = None) -> None:
        super().__init__()
        self.again, self.last = len(dims) // 2, last
        self.layers = nn.ModuleList(
            nn.Linear(before + (dims[0] if i == self.again else 0), after)
            for i, (before, after) in enumerate(pairwise(dims))
        )

    def forward(self, values: Float[Tensor, "M I"]) -> Float[Tensor, "M O"]:
        x = values
        for i, layer in enumerate(self.layers):
            if i == self.again:
                x = torch.cat((x, values), dim=-1)
            x = layer(x)
            if i < len(self.layers) - 1:
                x = leaky_relu(x, SLOPE)
        return torch.tanh(x) if self.last == "tanh" else x


def encode(values: Float[Tensor, "... D"], octaves: int = OCTAVES) -> Float[Tensor, "... E"]:
    """Each three values with their sines and cosines at 2^0 to 2^(octaves-1): 3 give 27 with 4 octaves, 6 give 54.

    D has to be a multiple of 3.
    """
    return positional_encoding(values.reshape(-1, 3), octaves).reshape(*values.shape[:-1], -1)


class Blended(NamedTuple):
    """What the networks say of each point, both paths together."""

    deformation: Float[Tensor, "N D"]
    colour: Float[Tensor, "N C"]
    attributes: Float[Tensor, "N A"]


class Outputs(NamedTuple):
    """How many values each of three networks gives."""

    deformation: int
    colour: int
    attributes: int


PUBLISHED = Outputs(3, 32, ATTRIBUTES)


class Branch(nn.Module):
    """Three networks with one condition, a vector that all points share. The sizes are those of their hidden layers."""

    def __init__(
        self,
        condition: int,
        features: int,
        outputs: Outputs,
        last: Literal["tanh"] | None,
        deformation: tuple[int, ...],
        colour: tuple[int, ...],
        attributes: tuple[int, ...],
    ) -> None:
        super().__init__()
        of_place, of_feature = encoded_size(OCTAVES) + condition, features + condition
        self.deformation = PointNetwork((of_place, *deformation, outputs.deformation), last)
        self.colour = PointNetwork((of_feature, *colour, outputs.colour))
        self.attributes = PointNetwork((of_feature, *attributes, outputs.attributes))

    def forward(
        self, codes: Float[Tensor, "M E"], features: Float[Tensor, "M F"], condition: Float[Tensor, " K"]
    ) -> Float[Tensor, "M O"]:
        """Deformation, colour and attributes side by side."""
        shared = condition.expand(len(codes), -1)
        of_place, of_feature = torch.cat((codes, shared), dim=-1), torch.cat((features, shared), dim=-1)
        return torch.cat((self.deformation(of_place), self.colour(of_feature), self.attributes(of_feature)), dim=-1)


class Networks(nn.Module):
    """The six networks, for an expression of `theta` values, a pose of 6 and points of `features` values.

    `outputs` are how many values they give; `bounded` puts the deformation through tanh.
    """

    def __init__(
        self,
        theta: int,
        width: int = 256,
        features: int = 128,
        outputs: Outputs = PUBLISHED,
        bounded: bool = True,
    ) -> None:
        super().__init__()
        half, self.outputs = max(width // 2, 1), outputs
        last = "tanh" if bounded else None
        of_pose = 2 * encoded_size(OCTAVES)
        self.expression = Branch(theta, features, self.outputs, last, (width,) * 5, (width,) * 2, (width,) * 3)
        self.pose = Branch(of_pose, features, self.outputs, last, (width,) * 2, (half,), (half,) * 2)

    def forward(
        self,
        places: Float[Tensor, "N 3"],
        features: Float[Tensor, "N F"],
        theta: Float[Tensor, " T"],
        beta: Float[Tensor, " B"],
        near: Float[Tensor, " N"],
    ) -> Blended:
        """`places` are normalised, about -1 to 1; `near` is `nearness`. Each path runs only on the points it counts for."""
        codes, features = encode(places), torch.tanh(features)
        blended = places.new_zeros(len(places), sum(self.outputs))
        paths = (self.expression, theta, near), (self.pose, encode(beta), 1.0 - near)
        for branch, condition, weight in paths:
            rows = _counting(weight > 0)
            values = branch(codes[rows], features[rows], condition) * weight[rows, None]
            blended = blended.index_add(0, rows, values)
        return Blended(*blended.split(self.outputs, dim=1))


def _counting(chosen: Bool[Tensor, " N"]) -> Tensor:
    return chosen.nonzero().squeeze(1)


@torch.no_grad()
def nearness(
    points: Float[Tensor, "N 3"], landmarks: Float[Tensor, "L 3"], near_distance: float, far_distance: float
) -> Float[Tensor, " N"]:
    """clamp((far^2 - d^2) / (far^2 - near^2), 0, 1), with d the distance to the nearest landmark; all in metres."""
    origin = landmarks.mean(dim=0)  # small numbers, because differences of squares follow
    landmarks = landmarks - origin
    lengths = landmarks.square().sum(dim=1)
    nearest: list[Tensor] = []
    for part in (points - origin).split(CHUNK):
        beyond = torch.addmm(lengths, part, landmarks.T, alpha=-2.0).amin(dim=1)  # d^2 without |point|^2
        nearest.append(beyond + part.square().sum(dim=1))
    near, far = near_distance**2, far_distance**2
    return ((far - torch.cat(nearest)) / (far - near)).clamp(0.0, 1.0)
