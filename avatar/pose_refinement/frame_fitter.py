"""How well the avatar's pictures of a time fit what its cameras saw, as a function of the tracking, with its gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import huber_loss

from avatar.compute.device import to_device
from avatar.data.frame import Frame
from avatar.gaussians.base_model import Avatar
from avatar.head.model import HeadModel
from avatar.losses.metrics import bounding_box, psnr
from avatar.pose_refinement.tracking_values import HeadPose, head_params, moved_pose
from avatar.types import Camera

# The squared error of a frame counts as this many independent observations with this standard deviation. Errors of
# neighbouring pixels come from the same fault of the avatar, so that a picture says far less than its pixels would.
OBSERVATIONS, PIXEL_SIGMA = 60.0, 0.05
HUBER_DELTA = 0.1
MARGIN = 8  # pixels around the head mask: what the avatar paints there is wrong
COARSEST = 224  # pixels of width: on fewer a step takes as long, and finds nothing that one on all does not


class Target(NamedTuple):
    """What the avatar is compared with, at one size."""

    camera: Camera
    place: HeadPose | None  # of the camera: p_cam = R p_ref + t; None: it is the reference camera
    box: tuple[slice, slice]  # rows and columns that are compared
    picture: Float[Tensor, "h w 3"]  # of the box
    mask: Float[Tensor, "h w"]  # of the head
    area: float  # of the head, pixels
    shrink: float  # of areas, from the full size

    def on(self, device: torch.device) -> Target:
        """The pictures there."""
        place = None if self.place is None else self.place.on(device)
        return self._replace(picture=to_device(self.picture, device), mask=to_device(self.mask, device), place=place)


def targets(
    frame: Frame, background: Float[Tensor, " 3"], levels: int, place: HeadPose | None = None
) -> list[Target] | None:
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
                place=place,
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


Pictures = Sequence[Float[Tensor, "_ _ 3"]]  # of each target its box


def head_psnr(pictures: Pictures, targets: Sequence[Target]) -> Float[Tensor, ""]:
    """Of the head alone, dB, float64; the mean over the pictures."""
    return torch.stack(
        [
            psnr(picture.clamp(0.0, 1.0), target.picture, target.mask)
            for picture, target in zip(pictures, targets, strict=True)
        ]
    ).mean()


class Fit(NamedTuple):
    """Of one time at one tracking."""

    misfit: Float[Tensor, ""]
    gradient: Float[Tensor, " P"]  # of the misfit in the time's values
    pictures: Pictures


@dataclass(frozen=True)
class FrameFitter:
    """An avatar that is not trained any more, over a background; all where the avatar is. Any number of threads may use it.

    On a GPU nothing is read back.
    """

    avatar: Avatar
    background: Float[Tensor, " 3"]
    centre: Float[Tensor, " 3"]  # that the head turns about, metres

    def pictures(self, values: Float[Tensor, " P"], given: HeadPose, targets: Sequence[Target]) -> Pictures:
        """The avatar in the targets' boxes; without a gradient."""
        with torch.no_grad():
            return self._draw(values, given, targets)

    def figures(self, values: Float[Tensor, " P"], given: HeadPose, targets: Sequence[Target]) -> Float[Tensor, " 2"]:
        """Misfit, and PSNR of the head alone in dB, where the avatar is, float64; without a gradient."""
        pictures = self.pictures(values, given, targets)
        return torch.stack((misfit(pictures, targets).double(), head_psnr(pictures, targets)))

    def fit(self, values: Float[Tensor, " P"], given: HeadPose, targets: Sequence[Target]) -> Fit:
        """How far the avatar's pictures are from the targets', and how that changes with the values."""
        values = values.detach().requires_grad_()
        pictures = self._draw(values, given, targets)
        error = misfit(pictures, targets)
        (gradient,) = torch.autograd.grad(error, values)
        return Fit(error.detach(), gradient, [picture.detach() for picture in pictures])

    @cached_property
    def _mesh(self) -> HeadModel:
        return self.avatar.mesh.on(self.centre.device)

    def _draw(self, values: Float[Tensor, " P"], given: HeadPose, targets: Sequence[Target]) -> Pictures:
        """Blurred by as much of the scene as at full size; differentiable in the values."""
        pose, params = moved_pose(values, given, self.centre), head_params(values)
        vertices = self._mesh.vertices(params) if torch.is_grad_enabled() else self.avatar.vertices(params)
        gaussians = self.avatar(params, vertices, pose.R)
        pictures = []
        for target in targets:
            R, t = pose if target.place is None else (target.place.R @ pose.R, target.place.R @ pose.t + target.place.t)
            camera = replace(target.camera, R_cam_world=R, t_cam_world=t)
            blur = target.shrink * self.avatar.config.blur
            drawing = self.avatar.draw(gaussians, camera, self.background, region=target.box, blur=blur)
            pictures.append(drawing.image[target.box])
        return pictures


def misfit(pictures: Pictures, targets: Sequence[Target]) -> Float[Tensor, ""]:
    """Half the sum of squared errors, in observations; of large errors less."""
    return torch.stack([_misfit(*pair) for pair in zip(pictures, targets, strict=True)]).sum()


def _misfit(picture: Float[Tensor, "h w 3"], target: Target) -> Float[Tensor, ""]:
    total = huber_loss(picture, target.picture, delta=HUBER_DELTA, reduction="sum")
    return OBSERVATIONS / PIXEL_SIGMA**2 * total / (3.0 * target.area)
