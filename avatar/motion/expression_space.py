"""The expressions that an avatar has seen in training: how far another one is from them, and the nearest that it can show.

A network that was trained on one person's expressions extrapolates outside of them. Coordinates of a face are its
expression coefficients and its jaw's rotation vector in units of 0.1 radians, about what a coefficient of one moves.
Gaze and eyelids are left out: they act on a small part of the face and are seen from end to end in any video.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from torch import Tensor

from avatar.head.model import matrix_from_6d
from avatar.types import HeadParams

JAW_UNIT = 0.1  # radians
FAR_PERCENTILE = 0.99  # of the training frames' own distances: what is beyond counts as far
# Standard deviation of a direction in which the training frames hardly move, as a share of the largest one: moving there is
# far, but not infinitely so.
LEAST_DEVIATION = 0.05


@dataclass(frozen=True)
class ExpressionSpace:
    """Principal components of the training frames' coordinates, C of them, by falling variance."""

    mean: Float[Tensor, " C"]
    components: Float[Tensor, "C C"]  # rows, orthonormal
    deviations: Float[Tensor, " C"]  # standard deviations along them, never below LEAST_DEVIATION of the first
    lowest: Float[Tensor, " C"]  # the training frames' range along them
    highest: Float[Tensor, " C"]
    far: float  # the FAR_PERCENTILE of the training frames' own distances

    def distances(self, motion: Sequence[HeadParams]) -> Float[Tensor, " T"]:
        """Mahalanobis distance of each frame from the training mean, as a multiple of `far`: above 1 is far."""
        return _mahalanobis(coordinates(motion) - self.mean, self.components, self.deviations) / self.far

    def nearest(self, motion: Sequence[HeadParams]) -> list[HeadParams]:
        """Each frame with its components clamped to the training frames' range along each.

        That projects too: the range is a point along a component that they never move in.
        """
        scores = (coordinates(motion) - self.mean) @ self.components.T
        return _with_coordinates(motion, self.mean + scores.clamp(self.lowest, self.highest) @ self.components)


def fit_expressions(training: Sequence[HeadParams]) -> ExpressionSpace:
    """The space of the frames that an avatar was trained on."""
    points = coordinates(training)
    mean = points.mean(dim=0)
    centred = points - mean
    variances, vectors = torch.linalg.eigh(centred.T @ centred / len(points))
    variances, components = variances.flip(0).clamp(min=0.0), vectors.flip(1).T.contiguous()
    deviations = variances.sqrt()
    # Frames that never move have no scale of their own: one coordinate's unit then is the scale.
    largest = float(deviations[0]) or 1.0
    deviations = deviations.clamp(min=LEAST_DEVIATION * largest)
    scores = centred @ components.T
    own = _mahalanobis(centred, components, deviations)
    far = float(torch.quantile(own, FAR_PERCENTILE)) or 1.0
    return ExpressionSpace(mean, components, deviations, scores.amin(dim=0), scores.amax(dim=0), far)


def coordinates(motion: Sequence[HeadParams]) -> Float[Tensor, "T C"]:
    """Expression coefficients, then the jaw's rotation vector / JAW_UNIT; float64."""
    expression = torch.stack([params.expression for params in motion]).double()
    jaw = matrix_from_6d(torch.stack([params.jaw for params in motion]).double())
    return torch.cat((expression, rotation_matrix_to_axis_angle(jaw) / JAW_UNIT), dim=1)


def _with_coordinates(motion: Sequence[HeadParams], points: Float[Tensor, "T C"]) -> list[HeadParams]:
    jaws = axis_angle_to_rotation_matrix(points[:, -3:] * JAW_UNIT)[:, :2].reshape(-1, 6)
    return [
        replace(params, expression=point[:-3].to(params.expression), jaw=jaw.to(params.jaw))
        for params, point, jaw in zip(motion, points, jaws, strict=True)
    ]


def _mahalanobis(
    centred: Float[Tensor, "T C"], components: Float[Tensor, "C C"], deviations: Float[Tensor, " C"]
) -> Float[Tensor, " T"]:
    return (centred @ components.T / deviations).norm(dim=1)
