"""Corrections of the training frames' head poses, trained with the avatar, as gsplat's CameraOptModule does.

A correction is a rotation vector w and a shift s across the image, in the axes of the reference camera, both small; depth,
which hardly shows in a picture, stays. It turns the head about its centre c:

    R' = (I + [w]x) R        t' = t + s - [w]x R c

to first order in w: a correction of half a degree stretches the head by 4e-5. So R' and t' are linear in the correction,
and a GPU needs a few launches for them; so are R_c R' and R_c t' + t_c, what another camera of a rig sees. Held-out frames
and drivers keep the poses of their tracking; therefore the corrections' mean over the training frames is subtracted: a pose
that all frames share is the avatar's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from kornia.geometry.conversions import vector_to_skew_symmetric_matrix
from torch import Tensor, nn

from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.types import Camera

TURN_UNIT, SHIFT_UNIT = 0.5 * math.pi / 180, 1e-3  # radians, metres: a tracker's usual errors
PREFIX = "pose_corrections."  # in a checkpoint


def make_pose_corrections(avatar: Avatar, times: Sequence[int], config: TrainerConfig) -> PoseCorrections | None:
    """For a training on the frames of these times, where the avatar is; None at `pose_rate` 0."""
    if config.pose_rate == 0:
        return None
    return PoseCorrections(times, avatar.head.neutral_vertices().mean(dim=0)).to(avatar.device)


class PoseCorrections(nn.Module):
    """One correction for each time of the training frames, zero at the start; `centre` of the head, metres."""

    def __init__(self, times: Sequence[int], centre: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.rows = {time: row for row, time in enumerate(times)}  # of `moves`
        self.moves = nn.Parameter(torch.zeros(len(times), 5))  # w and the two parts of s, in units
        self._centre = centre

    def jacobian(self, camera: Camera) -> Float[Tensor, "5 12"]:
        """What one unit of each part of a correction adds to (R row by row, t) of a camera; all on the CPU."""
        R = camera.head_rotation
        turns = TURN_UNIT * vector_to_skew_symmetric_matrix(torch.eye(3, dtype=R.dtype)) @ R
        shifts = SHIFT_UNIT * torch.eye(3, dtype=R.dtype)[:2]
        if camera.R_ref_cam is not None:  # of the head before the reference camera, seen by this one
            turns, shifts = camera.R_ref_cam.T @ turns, shifts @ camera.R_ref_cam
        turned = torch.cat((turns.flatten(1), -turns @ self._centre.to(R.dtype)), dim=1)
        return torch.cat((turned, torch.nn.functional.pad(shifts, (9, 0))))

    def forward(self, camera: Camera, row: Int[Tensor, "1"], jacobian: Float[Tensor, "5 12"]) -> Camera:
        """The camera of the frame in this row, corrected; differentiable in its correction."""
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
