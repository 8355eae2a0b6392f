"""Corrections of the training frames' head poses, trained with the avatar, as gsplat's CameraOptModule does.

A correction is a rotation vector w and a shift s in the camera's axes. With c the head's centre and p = R c + t,

    R' = exp([w]x) R        t' = exp([w]x) (t - p) + p + s

Held-out frames and drivers keep the poses of their tracking. So the corrections' mean over the training frames is
subtracted: a pose that all frames share is the avatar's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.model import Avatar
from avatar.pose_refinement.motion import HeadPose, moved_pose
from avatar.types import Camera

TURN_UNIT, SHIFT_UNIT, DEPTH_UNIT = 0.5 * math.pi / 180, 1e-3, 0.5e-3  # radians, metres: a tracker's usual errors
PREFIX = "pose_corrections."  # in a checkpoint


def make_pose_corrections(avatar: Avatar, frames: int, config: TrainerConfig) -> PoseCorrections | None:
    """For a training on so many frames, where the avatar is; None at `pose_rate` 0."""
    if config.pose_rate == 0:
        return None
    return PoseCorrections(frames, avatar.head.neutral_vertices().mean(dim=0)).to(avatar.code.device)


class PoseCorrections(nn.Module):
    """One correction for each of `frames` training frames, zero at the start; `centre` of the head, metres."""

    centre: Float[Tensor, "3"]
    unit: Float[Tensor, "6"]

    def __init__(self, frames: int, centre: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.moves = nn.Parameter(torch.zeros(frames, 6))  # w and s, in units
        self.register_buffer("unit", torch.tensor([TURN_UNIT] * 3 + [SHIFT_UNIT] * 2 + [DEPTH_UNIT]), persistent=False)
        self.register_buffer("centre", centre, persistent=False)

    def forward(self, camera: Camera, row: Int[Tensor, ""]) -> Camera:
        """The camera of training frame number `row`, corrected; differentiable in its correction."""
        own = self.moves.index_select(0, row.reshape(1))[0] - self.moves.detach().mean(dim=0)
        given = HeadPose(camera.R_cam_world, camera.t_cam_world)
        pose = moved_pose((own * self.unit).to(given.t), given, self.centre.to(given.t))
        return replace(camera, R_cam_world=pose.R, t_cam_world=pose.t)

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the corrections of a checkpoint. Raises UserError where they are missing or are not of these frames."""
        moves = tensors.get(f"{PREFIX}moves")
        if moves is None or moves.shape != self.moves.shape:
            raise UserError(
                f"the checkpoint does not hold pose corrections of {len(self.moves)} training frames; training cannot "
                "go on from it"
            )
        with torch.no_grad():
            self.moves.copy_(moves)
