"""Corrections of the training frames' head poses, trained with the avatar, as gsplat's CameraOptModule does.

A correction is a rotation vector w and a shift s in the camera's axes, both small. It turns the head about its centre c:

    R' = (I + [w]x) R        t' = t + s - [w]x R c

to first order in w: a correction of half a degree stretches the head by 4e-5. So R' and t' are linear in the correction,
and a GPU needs a few launches for them. Held-out frames and drivers keep the poses of their tracking; therefore the
corrections' mean over the training frames is subtracted: a pose that all frames share is the avatar's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from kornia.geometry.conversions import vector_to_skew_symmetric_matrix
from torch import Tensor, nn

from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.model import Avatar
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

    def __init__(self, frames: int, centre: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.moves = nn.Parameter(torch.zeros(frames, 6))  # w and s, in units
        self._centre = centre

    def jacobian(self, R: Float[Tensor, "3 3"]) -> Float[Tensor, "6 12"]:
        """What one unit of each part of a correction adds to (R row by row, t) of a camera; all on the CPU."""
        turns = TURN_UNIT * vector_to_skew_symmetric_matrix(torch.eye(3, dtype=R.dtype)) @ R
        shifts = torch.diag(torch.tensor([SHIFT_UNIT, SHIFT_UNIT, DEPTH_UNIT], dtype=R.dtype))
        still = torch.zeros(3, 9, dtype=R.dtype)
        turned = torch.cat((turns.flatten(1), -turns @ self._centre.to(R.dtype)), dim=1)
        return torch.cat((turned, torch.cat((still, shifts), dim=1)))

    def forward(self, camera: Camera, row: Int[Tensor, "1"], jacobian: Float[Tensor, "6 12"]) -> Camera:
        """The camera of training frame number `row`, corrected; differentiable in its correction."""
        own = self.moves.index_select(0, row)[0] - self.moves.detach().mean(dim=0)
        given = torch.cat((camera.R_cam_world.flatten(), camera.t_cam_world))
        R, t = torch.addmv(given, jacobian.T, own.to(given.dtype)).split((9, 3))
        return replace(camera, R_cam_world=R.view(3, 3), t_cam_world=t)

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
