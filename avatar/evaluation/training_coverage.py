"""How far a frame is from what training has seen: the angle of view and the distance of the expression."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.recording import Recording
from avatar.head.model import HeadModel
from avatar.motion.orbit import seen_from
from avatar.types import IDENTITY_6D, HeadParams


class Conditions(NamedTuple):
    """Field names are columns of frames.csv."""

    yaw: float  # degrees, from the front 0, positive from the head's own left
    expression_distance: float  # mm


def conditions(head: HeadModel, recording: Recording, indices: Sequence[int]) -> dict[int, Conditions]:
    """The conditions of these frames; distances are to the nearest of the training frames."""
    distances = expression_distances(
        head, [recording.params(i) for i in indices], recording.motion(recording.split.train)
    )
    return {
        index: Conditions(seen_from(recording.camera(index)).yaw, distance)
        for index, distance in zip(indices, distances, strict=True)
    }


def expression_distances(head: HeadModel, frames: Sequence[HeadParams], training: Sequence[HeadParams]) -> list[float]:
    """For each frame the root mean square distance of its vertices, in mm, from the nearest training frame's.

    Vertices in the head's own space, the torso at rest: expression, jaw, eyes and lids count, poses do not.
    """
    shapes = torch.stack([_shape(head, params) for params in (*training, *frames)])
    shapes = (shapes - shapes[0]).flatten(1)  # small numbers, because cdist takes differences of squares
    seen, asked = shapes[: len(training)], shapes[len(training) :]
    vertices = shapes.shape[1] / 3
    nearest = torch.cdist(asked, seen).amin(dim=1) / math.sqrt(vertices)
    return (nearest * 1000.0).tolist()


def _shape(head: HeadModel, params: HeadParams) -> Float[Tensor, "V 3"]:
    return head.vertices(replace(params, neck=params.neck.new_tensor(IDENTITY_6D)))
