"""Faces move smoothly: differences between neighbouring frames as terms of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE
from data_prep.track.fit.camera import to_camera
from data_prep.track.fit.frame_poses import Columns, Motion, cross_matrix
from data_prep.track.fit.normal_equations import NormalEquations

NOMINAL_FPS = 25.0
POSE_SECOND = (0.6e-3, 0.6e-3, 1.2e-3)  # metres, of four points on the head along the camera's axes
EXPRESSION_BOTH, JAW_BOTH = 0.06, 0.02  # of first and of second differences
GAZE_FIRST, EYELIDS_FIRST = 0.15, 0.3  # eyes and lids move fast: first differences only


@dataclass(frozen=True)
class Smoothness:
    """Standard deviations of first and second differences. Frames that do not follow each other are not compared."""

    head_points: Float[Tensor, "4 3"]  # in the head's space, metres
    follows: Float[Tensor, " T"]  # 1 where a frame comes right after the one before it
    pose: Float[Tensor, " 3"]  # 1 / deviation
    first: Float[Tensor, " C"]  # 1 / variance, of all columns but the pose
    second: Float[Tensor, " C"]

    def take(self, frames: slice) -> Smoothness:
        follows = self.follows[frames].clone()
        follows[:1] = 0.0
        return Smoothness(self.head_points, follows, self.pose, self.first, self.second)

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        one, two = self.follows[1:, None], (self.follows[2:] * self.follows[1:-1])[:, None]
        values = motion.coefficients()
        points = to_camera(motion, self.head_points.expand(len(motion), 4, 3)) * self.pose
        total = (one * values.diff(dim=0).pow(2) * self.first).sum()
        total = total + (two * values.diff(n=2, dim=0).pow(2) * self.second).sum()
        return float(0.5 * (total + (two[..., None] * points.diff(n=2, dim=0).pow(2)).sum()))

    def add_to(
        self,
        equations: NormalEquations,
        identity: Float[Tensor, " I"],
        motion: Motion,
    ) -> None:
        if len(motion) < 2:
            return
        self._add_coefficients(equations, motion)
        if len(motion) > 2:
            self._add_pose(equations, motion)

    def _add_coefficients(self, equations: NormalEquations, motion: Motion) -> None:
        own, values = Columns.HEAD, motion.coefficients()
        for order, precision in ((1, self.first), (2, self.second)):
            if len(motion) <= order:
                continue
            stencil = (-1.0, 1.0) if order == 1 else (1.0, -2.0, 1.0)
            counted = self.follows[1:] if order == 1 else self.follows[2:] * self.follows[1:-1]
            weight = counted[:, None] * precision  # [T - order, C]
            difference = weight * values.diff(n=order, dim=0)
            T = len(motion) - order
            for i, a in enumerate(stencil):
                equations.gradient[i : i + T, own] += a * difference
                for k, b in enumerate(stencil[: i + 1]):
                    block = _block(equations, i - k)[i : i + T, own, own]
                    torch.diagonal(block, dim1=1, dim2=2).add_(a * b * weight)

    def _add_pose(self, equations: NormalEquations, motion: Motion) -> None:
        T = len(motion) - 2
        points = to_camera(motion, self.head_points.expand(len(motion), 4, 3))
        arms = points - motion.t[:, None]
        eye = torch.eye(3, dtype=torch.float64).expand(*arms.shape, 3)
        J = (torch.cat((-cross_matrix(arms), eye), dim=-1) * self.pose[:, None]).flatten(1, 2)  # [T, 12, 6]
        counted = (self.follows[2:] * self.follows[1:-1])[:, None]
        residual = counted * (points * self.pose).flatten(1).diff(n=2, dim=0)  # [T - 2, 12]
        pose = Columns.POSE
        for i, a in enumerate((1.0, -2.0, 1.0)):
            Ji = J[i : i + T]
            equations.gradient[i : i + T, pose] += a * torch.einsum("trc,tr->tc", Ji, residual)
            for k, b in enumerate((1.0, -2.0, 1.0)[: i + 1]):
                product = torch.einsum("trc,trd->tcd", Ji * counted[..., None], J[k : k + T])
                _block(equations, i - k)[i : i + T, pose, pose] += a * b * product


def _block(equations: NormalEquations, back: int) -> Tensor:
    return (equations.diagonal, equations.before, equations.before_that)[back]


def make_smoothness(
    assets: HeadAssets, frames: Int[Tensor, " T"], fps: float, expressions: int, statistical: bool
) -> Smoothness:
    """For the frames with these numbers. At another frame rate, differences scale as those of a driven random walk."""
    eyes = (assets.joint_regressor.double() @ assets.template.double())[[LEFT_EYE, RIGHT_EYE]]
    distance = float((eyes[0] - eyes[1]).norm())
    middle = eyes.mean(0) - torch.tensor([0.0, 0.0, 0.7 * distance], dtype=torch.float64)
    around = distance * torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.5, 0]], dtype=torch.float64)
    slower = NOMINAL_FPS / fps
    C = Columns.EXPRESSION.start - Columns.HEAD.start + expressions
    both = torch.empty(C, dtype=torch.float64)
    fast = slice(Columns.GAZE.start - Columns.HEAD.start, Columns.EYELIDS.stop - Columns.HEAD.start)
    for columns, deviation in (
        (Columns.JAW, JAW_BOTH),
        (Columns.GAZE, GAZE_FIRST),
        (Columns.EYELIDS, EYELIDS_FIRST),
        (Columns.EXPRESSION, EXPRESSION_BOTH * (3.0 if statistical else 1.0)),
    ):
        stop = None if columns.stop is None else columns.stop - Columns.HEAD.start
        both[columns.start - Columns.HEAD.start : stop] = deviation
    first, second = both.pow(-2) / slower, both.pow(-2) / slower**3
    second[fast] = 0.0
    follows = torch.zeros(len(frames), dtype=torch.float64)
    follows[1:] = (frames.diff() == 1).double()
    pose = 1.0 / (torch.tensor(POSE_SECOND, dtype=torch.float64) * slower**1.5)
    return Smoothness(middle + around, follows, pose, first, second)
