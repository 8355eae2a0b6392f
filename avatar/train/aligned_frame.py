"""A training frame whose tracking is moved for one step, and the way from the step's loss to its tracking.

On a CPU the frame's camera moves, which the splatter does not differentiate: its gradient comes from those of what was
drawn. On a GPU, which would have to hand a moved camera back, the head moves before it, and autograd does the rest. Both
leave out how a turn of the head changes the colours that depend on the view and, with `model.head_rotation`,
the network's input, which on a GPU is the given rotation meanwhile.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from avatar.compute.device import on_gpu
from avatar.pose_refinement.frame_fitter import FrameFitter, before_camera, camera_gradient
from avatar.pose_refinement.motion import TURN, HeadPose, head_params, moved_pose, values_of
from avatar.train.step import Judge, Objective, sh_degree, training_step
from avatar.types import Frame, Gaussians


class AlignedFrame(Protocol):
    frame: Frame  # with its tracking where it was moved to; differentiable in the values of the face

    def watched(self, gaussians: Gaussians) -> Gaussians:
        """What is to be drawn of them, so that the gradient can be had."""
        ...

    def gradient(self) -> Float[Tensor, " P"]:
        """Of the loss in the frame's values, once it has been differentiated."""
        ...


def place(
    frame: Frame, values: Float[Tensor, " P"], given: HeadPose, centre: Float[Tensor, 3], sh_degree: int
) -> AlignedFrame:
    """The frame with these values of its tracking, which has the head pose `given`; `centre` of the head, metres.

    All but the frame's camera are where the avatar is. `sh_degree` is that of the colours that take part in the step.
    """
    if on_gpu(values):
        return _HeadPlaced(frame, values, given, centre, sh_degree)
    return _CameraPlaced(frame, values, given, centre)


class _CameraPlaced:
    def __init__(self, frame: Frame, values: Tensor, given: HeadPose, centre: Tensor) -> None:
        self._values = values.detach().requires_grad_()
        self._pose = moved_pose(self._values, given, centre)
        self._still = HeadPose(self._pose.R.detach(), self._pose.t.detach())
        camera = replace(frame.camera, R_cam_world=self._still.R, t_cam_world=self._still.t)
        self.frame = replace(frame, camera=camera, params=head_params(self._values))
        self._drawn: Gaussians | None = None

    def watched(self, gaussians: Gaussians) -> Gaussians:
        """The same, which keep what drawing them has as gradient."""
        self._drawn = gaussians._replace(means=_watched(gaussians.means), quats=_watched(gaussians.quats))
        return self._drawn

    def gradient(self) -> Float[Tensor, " P"]:
        drawn, through_face = self._drawn, self._values.grad
        assert drawn is not None and drawn.means.grad is not None and through_face is not None
        by_quats = torch.zeros_like(drawn.quats) if drawn.quats.grad is None else drawn.quats.grad
        by_pose = camera_gradient(drawn, self._still, drawn.means.grad, by_quats)
        (through_pose,) = torch.autograd.grad(tuple(self._pose), self._values, tuple(by_pose))
        return through_face + through_pose


def _watched(values: Tensor) -> Tensor:
    own = values.view_as(values) if values.requires_grad else values.clone().requires_grad_()
    own.retain_grad()
    return own


class _HeadPlaced:
    def __init__(self, frame: Frame, values: Tensor, given: HeadPose, centre: Tensor, sh_degree: int) -> None:
        self._values = values.detach().requires_grad_()
        self._given, self._sh_degree = given, sh_degree
        self._pose = moved_pose(self._values, given, centre)
        self.frame = replace(frame, params=head_params(self._values))

    def watched(self, gaussians: Gaussians) -> Gaussians:
        """The same before the frame's camera, which has the given pose; coloured, and their higher coefficients zero."""
        R, t = self._pose
        directions = (gaussians.means @ R.T + t) @ R.detach()  # in which they are seen, as the CPU has it
        moved = before_camera(gaussians, self._values[TURN], self._pose, self._given, directions, self._sh_degree)
        return moved._replace(sh=pad(moved.sh, (0, 0, 0, gaussians.sh.shape[1] - 1)))

    def gradient(self) -> Float[Tensor, " P"]:
        assert self._values.grad is not None
        return self._values.grad


def moving_step(
    fitter: FrameFitter,
    optimizer: torch.optim.Adam,
    objective: Objective,
    step: int,
    frame: Frame,
    judge: Judge | None = None,
) -> None:
    """What step number `step` (from 0) takes where it moves its frame's tracking, for who times it; by nothing."""
    avatar, params = fitter.avatar, frame.params
    given = HeadPose(frame.camera.R_cam_world, frame.camera.t_cam_world).on(avatar.device)
    tracks = {name: getattr(params, name)[None] for name in ("neck", "jaw", "eyes", "eyelids", "expression")}
    values = values_of(tracks | {"t": given.t[None]})[0]
    degree = sh_degree(step)
    placed = place(frame, values, given, fitter.centre, degree)
    posed = fitter.vertices(placed.frame.params)
    training_step(avatar, optimizer, objective, step, placed.frame, posed, judge, placed.watched)
    placed.gradient()
