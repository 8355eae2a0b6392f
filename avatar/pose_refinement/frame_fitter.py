"""How well the avatar's picture of a frame fits the frame, as a function of the frame's tracking, with its gradient.

The avatar is drawn with the frame's own camera, which the splatter does not differentiate. Moving a camera is moving the
head the other way, so the gradient in the head's pose is put together from the splatter's gradients in the Gaussians'
means and rotations, exactly; colours depend on the direction from which they are seen, and are computed here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import torch
from jaxtyping import Float
from kornia.geometry.conversions import vector_to_skew_symmetric_matrix
from torch import Tensor
from torch.nn.functional import huber_loss, normalize

from avatar.compute.device import on_gpu, to_device
from avatar.gaussians.avatar import SH_DEGREE, Avatar
from avatar.head.model import HeadModel
from avatar.losses.metrics import bounding_box, psnr
from avatar.pose_refinement.motion import TURN, HeadPose, head_params, moved_pose, quaternion
from avatar.splat.sh import C0, sh_colours
from avatar.types import Camera, Frame, Gaussians, HeadParams

# The squared error of a frame counts as this many independent observations with this standard deviation. Errors of
# neighbouring pixels come from the same fault of the avatar, so that a picture says far less than its pixels would.
OBSERVATIONS, PIXEL_SIGMA = 60.0, 0.05
HUBER_DELTA = 0.1
MARGIN = 8  # pixels around the head mask: what the avatar paints there is wrong
COARSEST = 224  # pixels of width: on fewer a step takes as long, and finds nothing that one on all does not


class Target(NamedTuple):
    """What the avatar is compared with, at one size."""

    camera: Camera
    box: tuple[slice, slice]  # rows and columns that are compared
    picture: Float[Tensor, "h w 3"]  # of the box
    mask: Float[Tensor, "h w"]  # of the head
    area: float  # of the head, pixels
    shrink: float  # of areas, from the full size

    def on(self, device: torch.device, given: HeadPose) -> Target:
        """There, but for the camera, which takes the given pose of the head (on the CPU)."""
        camera = replace(self.camera, R_cam_world=given.R, t_cam_world=given.t)
        return self._replace(camera=camera, picture=to_device(self.picture, device), mask=to_device(self.mask, device))


def targets(frame: Frame, background: Float[Tensor, 3], levels: int) -> list[Target] | None:
    """The frame at its own size and at `levels` - 1 halves of it; None where no head is to be seen."""
    picture, mask = frame.composite(background), frame.head_mask
    if bounding_box(mask) is None:
        return None
    made = []
    for level in range(levels):
        width, height = (max(1, side >> level) for side in (frame.camera.width, frame.camera.height))
        small, head = (resized(image, width, height) for image in (picture, mask))
        box = bounding_box(head)
        assert box is not None  # what is there at full size leaves something in the mean
        margin = max(1, MARGIN >> level)
        rows, columns = (
            slice(max(side.start - margin, 0), min(side.stop + margin, length))
            for side, length in zip(box, head.shape, strict=True)
        )
        camera = frame.camera.resized(width, height)
        made.append(
            Target(
                camera=camera,
                box=(rows, columns),
                picture=small[rows, columns].contiguous(),
                mask=head[rows, columns].contiguous(),
                area=float(head.sum()),
                shrink=(width / frame.camera.width) ** 2,
            )
        )
    return made


def coarse_levels(width: int) -> int:
    """Into how many sizes, each half of the one before, a picture of so many pixels' width is worth being divided."""
    return 1 + sum(width >> level >= COARSEST for level in range(1, 16))


def resized(image: Tensor, width: int, height: int) -> Tensor:
    if image.shape[:2] == (height, width):
        return image
    return torch.from_numpy(cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA))


def head_psnr(picture: Float[Tensor, "h w 3"], target: Target) -> Float[Tensor, ""]:
    """Of the head alone, dB, float64."""
    return psnr(picture.clamp(0.0, 1.0), target.picture, target.mask)


class Measure(NamedTuple):
    """Of one frame at one tracking."""

    misfit: float
    psnr: float  # of the head alone, dB


class Fit(NamedTuple):
    """Of one frame at one tracking."""

    misfit: Float[Tensor, ""]
    gradient: Float[Tensor, " P"]  # of the misfit in the frame's values
    picture: Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class FrameFitter:
    """An avatar that is not trained any more, over a background; all where the avatar is. Any number of threads may use it.

    On a GPU nothing is read back: what the methods give is there, but for what `measure` gives.
    """

    avatar: Avatar
    background: Float[Tensor, 3]
    centre: Float[Tensor, 3]  # that the head turns about, metres

    def picture(self, values: Float[Tensor, " P"], given: HeadPose, target: Target) -> Float[Tensor, "h w 3"]:
        """The avatar in the target's box; without a gradient."""
        with torch.no_grad():
            pose = moved_pose(values, given, self.centre)
            gaussians = self.avatar(head_params(values), None, pose.R)
            if on_gpu(values):
                return self._draw_moved(gaussians, values, pose, given, target)
            return self._draw(gaussians, pose, gaussians.sh, target)

    def measure(self, values: Float[Tensor, " P"], given: HeadPose, target: Target) -> Measure:
        """Without a gradient."""
        return Measure(*self.figures(values, given, target).tolist())

    def figures(self, values: Float[Tensor, " P"], given: HeadPose, target: Target) -> Float[Tensor, 2]:
        """What `measure` gives, where the avatar is, float64."""
        picture = self.picture(values, given, target)
        return torch.stack((misfit(picture, target).double(), head_psnr(picture, target)))

    def fit(self, values: Float[Tensor, " P"], given: HeadPose, target: Target) -> Fit:
        """How far the avatar's picture is from the target's, and how that changes with the values."""
        values = values.detach().requires_grad_()
        pose = moved_pose(values, given, self.centre)
        if on_gpu(values):
            gaussians = self.avatar(params := head_params(values), self.vertices(params), pose.R)
            picture = self._draw_moved(gaussians, values, pose, given, target)
            error = misfit(picture, target)
            (gradient,) = torch.autograd.grad(error, values)
            return Fit(error.detach(), gradient, picture.detach())
        eye = -(pose.R.T @ pose.t)  # where the camera is, in the head's space
        gaussians = self.avatar(head_params(values), None, pose.R)
        # Leaves and nodes of their own, so that the ways to the picture stay apart: through the drawing and the colours.
        quats = gaussians.quats if gaussians.quats.requires_grad else gaussians.quats.clone().requires_grad_()  # ndgs
        drawn = gaussians._replace(means=gaussians.means.view_as(gaussians.means), quats=quats)
        camera = HeadPose(*(part.detach() for part in pose))
        seen_from = eye.detach().requires_grad_()
        colours = sh_colours(gaussians.sh, normalize(gaussians.means - seen_from, dim=-1), SH_DEGREE)
        flat = ((colours - 0.5) / C0)[:, None]
        picture = self._draw(drawn, camera, flat, target)
        error = misfit(picture, target)
        sources = (values, drawn.means, drawn.quats, seen_from)
        by_values, by_means, by_quats, by_eye = torch.autograd.grad(error, sources, retain_graph=True)
        by_pose = camera_gradient(drawn, camera, by_means, by_quats)
        (through_pose,) = torch.autograd.grad((*pose, eye), values, (*by_pose, by_eye))
        return Fit(error.detach(), by_values + through_pose, picture.detach())

    @cached_property
    def _mesh(self) -> HeadModel:
        return self.avatar.mesh.on(self.centre.device)

    def vertices(self, params: HeadParams) -> Float[Tensor, "V 3"]:
        """The posed mesh where the avatar is, metres; differentiable."""
        return self._mesh.vertices(params)

    def _draw_moved(
        self, gaussians: Gaussians, values: Tensor, pose: HeadPose, given: HeadPose, target: Target
    ) -> Float[Tensor, "h w 3"]:
        """Moves the head before the target's own camera, which has the given pose: a GPU would have to hand a moved camera
        back. Differentiable by autograd alone."""
        directions = gaussians.means + (pose.R.T @ pose.t)
        moved = before_camera(gaussians, values[TURN], pose, given, directions, SH_DEGREE)
        return self._drawn(moved, target.camera, target)

    def _draw(self, gaussians: Gaussians, pose: HeadPose, sh: Tensor, target: Target) -> Float[Tensor, "h w 3"]:
        camera = replace(target.camera, R_cam_world=pose.R, t_cam_world=pose.t)
        return self._drawn(gaussians._replace(sh=sh), camera, target)

    def _drawn(self, gaussians: Gaussians, camera: Camera, target: Target) -> Float[Tensor, "h w 3"]:
        """Blurred by as much of the scene as at full size."""
        blur = target.shrink * self.avatar.config.blur
        return self.avatar.draw(gaussians, camera, self.background, region=target.box, blur=blur).image[target.box]


def before_camera(
    gaussians: Gaussians,
    turn: Float[Tensor, 3],
    pose: HeadPose,
    given: HeadPose,
    directions: Float[Tensor, "N 3"],
    sh_degree: int,
) -> Gaussians:
    """The Gaussians of a head with this pose, moved to before a camera that takes it to have the pose `given`.

    turn         of the pose from the given one, rotation vector, radians, camera axes
    directions   from the camera, of any length, in the head's space: that in which each is seen, which decides its colour;
                 what is given back has that colour from everywhere, in one coefficient
    """
    colours = sh_colours(gaussians.sh, normalize(directions, dim=-1), sh_degree)
    means = (gaussians.means @ pose.R.T + (pose.t - given.t)) @ given.R
    quats = turned(quaternion(given.R.T @ turn), gaussians.quats)
    return gaussians._replace(means=means, quats=quats, sh=((colours - 0.5) / C0)[:, None])


def turned(by: Float[Tensor, 4], quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """The product of a quaternion with each of others, (w, x, y, z)."""
    w, x, y, z = by
    product = torch.stack((w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w)).reshape(4, 4)
    return quats @ product.T


def misfit(picture: Float[Tensor, "h w 3"], target: Target) -> Float[Tensor, ""]:
    """Half the sum of squared errors, in observations; of large errors less."""
    total = huber_loss(picture, target.picture, delta=HUBER_DELTA, reduction="sum")
    return OBSERVATIONS / PIXEL_SIGMA**2 * total / (3.0 * target.area)


@torch.no_grad()
def camera_gradient(
    gaussians: Gaussians, camera: HeadPose, by_means: Float[Tensor, "N 3"], by_quats: Float[Tensor, "N 4"]
) -> HeadPose:
    """The gradient in the camera's R and t of a drawing whose gradients in means and quats are known.

    What is drawn depends on R m + t and on the covariances turned by R. So t takes the sum of the points' gradients, turned
    into the camera's axes, and R their products with the points. Turning the camera by a small rotation vector d is turning
    every covariance by a = R^T d in the head's space, which changes its quaternion q by (0, a) q / 2.
    """
    R = camera.R
    w, v = gaussians.quats[:, :1], gaussians.quats[:, 1:]
    by_w, by_v = by_quats[:, :1], by_quats[:, 1:]
    spin = 0.5 * (w * by_v - by_w * v + torch.linalg.cross(v, by_v)).sum(dim=0)
    # The matrix whose product with a change of R, [d]x R, is d times the spin in the camera's axes.
    by_R = R @ (by_means.T @ gaussians.means) + 0.5 * vector_to_skew_symmetric_matrix((R @ spin)[None])[0] @ R
    return HeadPose(by_R, R @ by_means.sum(dim=0))
