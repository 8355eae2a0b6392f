"""What refinement moves: a frame's tracking as one vector of values.

    turn        3          rotation vector in radians, of the head about its centre, in the camera's axes
    shift       3          metres, in the camera's axes
    neck, jaw   3 each     rotation vectors
    eyes        6          two rotation vectors, left then right
    eyelids     2
    expression  E

`turn` and `shift` are relative to the given head pose and so zero at the start; everything else is the value itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from kornia.geometry.conversions import rotation_matrix_to_axis_angle, vector_to_skew_symmetric_matrix
from torch import Tensor

from avatar.compute.device import to_device
from avatar.head.model import matrix_from_6d
from avatar.types import HeadParams

TURN, SHIFT, NECK, JAW, EYES, EYELIDS = (
    slice(start, stop) for start, stop in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 18), (18, 20))
)
EXPRESSION = slice(20, None)
POSE = slice(0, 6)
JOINTS = slice(6, 18)  # the rotation vectors of neck, jaw and eyes
PARTS = {"neck": NECK, "jaw": JAW, "eyes": EYES, "eyelids": EYELIDS, "expression": EXPRESSION}

Tracks = Mapping[str, Tensor]  # as `Subject.tracks`


class HeadPose(NamedTuple):
    """Head to camera: p_cam = R p + t."""

    R: Float[Tensor, "*B 3 3"]
    t: Float[Tensor, "*B 3"]

    def on(self, device: torch.device) -> HeadPose:
        return HeadPose(to_device(self.R, device), to_device(self.t, device))


def rotation(vectors: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation vectors -> matrices by Rodrigues' formula; smooth everywhere, at zero too."""
    skew = vector_to_skew_symmetric_matrix(vectors.reshape(-1, 3)).reshape(*vectors.shape, 3)
    angle = (vectors.square().sum(dim=-1)[..., None, None] + 1e-20).sqrt()  # its derivative at zero is a number
    sine, cosine = torch.sinc(angle / math.pi), 0.5 * torch.sinc(angle / (2.0 * math.pi)).square()
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + sine * skew + cosine * (skew @ skew)


def six_d(matrices: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 6"]:
    """The first two rows, flattened."""
    return matrices[..., :2, :].flatten(-2)


def values_of(tracks: Tracks) -> Float[Tensor, "T P"]:
    """The given motion as vectors."""
    joints = torch.cat((tracks["neck"], tracks["jaw"], tracks["eyes"]), dim=1).reshape(-1, 6)
    # float64: the angle comes from a trace near 3, where float32 has lost half its digits
    vectors = rotation_matrix_to_axis_angle(matrix_from_6d(joints.double())).to(tracks["t"].dtype)
    still = tracks["t"].new_zeros(len(tracks["t"]), 6)
    return torch.cat((still, vectors.reshape(len(still), 12), tracks["eyelids"], tracks["expression"]), dim=1)


def head_params(values: Float[Tensor, " P"]) -> HeadParams:
    """Differentiable."""
    neck, jaw, left, right = six_d(rotation(values[JOINTS].reshape(4, 3)))
    return HeadParams(values[EXPRESSION], jaw, torch.cat((left, right)), values[EYELIDS], neck)


def moved_pose(values: Float[Tensor, "*B P"], given: HeadPose, centre: Float[Tensor, " 3"]) -> HeadPose:
    """The given head pose turned about `centre` (the head's, in its own space, metres) and shifted; differentiable."""
    turn, shift = rotation(values[..., TURN]), values[..., SHIFT]
    pivot = (given.R @ centre) + given.t
    return HeadPose(turn @ given.R, (turn @ (given.t - pivot)[..., None]).squeeze(-1) + pivot + shift)


def moved_tracks(
    tracks: Tracks, values: Float[Tensor, "T P"], changed: Bool[Tensor, " P"], centre: Float[Tensor, " 3"]
) -> dict[str, Tensor]:
    """The tracks with these values; a part of which nothing is `changed` keeps its bits."""
    moved = dict(tracks)
    joints = six_d(rotation(values[:, JOINTS].double().reshape(-1, 4, 3))).to(values.dtype)
    parts = {
        "neck": joints[:, 0],
        "jaw": joints[:, 1],
        "eyes": joints[:, 2:].flatten(1),
        "eyelids": values[:, EYELIDS],
        "expression": values[:, EXPRESSION],
    }
    moved |= {name: part.contiguous() for name, part in parts.items() if bool(changed[PARTS[name]].any())}
    given = HeadPose(tracks["R"].double(), tracks["t"].double())
    pose = moved_pose(values.double(), given, centre.double())
    moved |= {"R": pose.R.to(values.dtype), "t": pose.t.to(values.dtype)}
    return moved


def accelerations(tracks: Tracks, values: Float[Tensor, "T P"], centre: Float[Tensor, " 3"]) -> Float[Tensor, "T P"]:
    """Second differences of the given motion over neighbouring frames, float64; zero for the first and the last frame.

    Of the pose: how the rotation from frame to frame changes (rotation vectors, camera axes), and of the centre's place.
    """
    R, t = tracks["R"].double(), tracks["t"].double()
    found = torch.zeros(values.shape, dtype=torch.float64)
    if len(values) < 3:
        return found
    found[1:-1] = _second_differences(values.double())
    steps = rotation_matrix_to_axis_angle(R[1:] @ R[:-1].mT)
    found[1:-1, TURN] = steps[1:] - steps[:-1]
    found[1:-1, SHIFT] = _second_differences(R @ centre.double() + t)
    return found


def _second_differences(values: Float[Tensor, "T D"]) -> Float[Tensor, "T-2 D"]:
    return values[2:] - 2.0 * values[1:-1] + values[:-2]
