"""The values that flow through the program, and every convention, stated once.

Conventions
-----------
Camera      OpenCV: x right, y down, z forward; the centre of pixel (column i, row j) is at (i + 0.5, j + 0.5).
            `T_cam_world` style names say from-to: `p_cam = R_cam_world @ p_world + t_cam_world`. Lengths in metres,
            focal lengths and principal point in pixels of this camera's own width and height.
World       The posed head's own space: the head's pose, its neck's turn included, is in the camera, and the torso
            turns beneath it. Where several cameras film one head, each camera's pose holds the head's.
Rotations   Quaternions are (w, x, y, z) and are normalised where they are used. "6D" rotations are the first two rows
            of the matrix, flattened; the third row is their cross product (metrical-tracker's files).
Images      float32 [H, W, 3] (masks [H, W]) in [0, 1], the values of the 8-bit file / 255, unclamped until written.
Names       Raw and activated parameters differ in name: `log_scales` / `scales`, `opacity_logits` / `opacities`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.compute.device import to_device
from avatar.tensors import to_8_bit

IDENTITY_6D = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    R_cam_world and t_cam_world may require gradients. They are on the CPU or where the points and Gaussians are.
    """

    R_cam_world: Float[Tensor, "3 3"]
    t_cam_world: Float[Tensor, " 3"]  # metres
    fx: float  # pixels
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    R_ref_cam: Float[Tensor, "3 3"] | None = None  # to the axes of the rig's reference camera; None: it is its own

    @property
    def head_rotation(self) -> Float[Tensor, "3 3"]:
        """How the head is turned before the reference camera, whichever camera this is."""
        return self.R_cam_world if self.R_ref_cam is None else self.R_ref_cam @ self.R_cam_world

    def project(self, points: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """World points [..., 3] in metres -> (x pixel, y pixel, depth in metres)."""
        p = points @ self.R_cam_world.to(points).T + self.t_cam_world.to(points)
        z = p[..., 2]
        return torch.stack((p[..., 0] / z * self.fx + self.cx, p[..., 1] / z * self.fy + self.cy, z), dim=-1)

    def resized(self, width: int, height: int) -> Camera:
        """The same view on an image of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )


@dataclass(frozen=True)
class HeadParams:
    """What moves a FLAME-format head in one frame; identity coefficients belong to the subject, not to the frame."""

    expression: Float[Tensor, " E"]  # coefficients of the expression basis
    jaw: Float[Tensor, " 6"]  # 6D rotation
    eyes: Float[Tensor, " 12"]  # two 6D rotations, left then right
    eyelids: Float[Tensor, " 2"]  # blendshape weights, left then right
    neck: Float[Tensor, " 6"]  # 6D rotation of the head against the torso, which it moves; not a condition of the MLP

    def condition(self) -> Float[Tensor, " C"]:
        """The deformation network's per-frame input: expression, jaw, eyes, eyelids (120 values with 100 expressions)."""
        return torch.cat((self.expression, self.jaw, self.eyes, self.eyelids))

    def with_condition(self, condition: Float[Tensor, " C"]) -> HeadParams:
        """The same with another `condition`."""
        parts = (self.expression, self.jaw, self.eyes, self.eyelids)
        expression, jaw, eyes, eyelids = condition.split([len(part) for part in parts])
        return replace(self, expression=expression, jaw=jaw, eyes=eyes, eyelids=eyelids)

    def to(self, device: torch.device) -> HeadParams:
        """The same on another device, brought there in one copy."""
        if self.jaw.device == device:
            return self
        parts = (self.expression, self.jaw, self.eyes, self.eyelids, self.neck)
        expression, jaw, eyes, eyelids, neck = to_device(torch.cat(parts), device).split([len(part) for part in parts])
        return HeadParams(expression, jaw, eyes, eyelids, neck)


class Gaussians(NamedTuple):
    """What a splatter draws; every field activated, world space."""

    means: Float[Tensor, "N 3"]  # metres
    quats: Float[Tensor, "N 4"]  # (w, x, y, z), need not be normalised
    scales: Float[Tensor, "N 3"]  # standard deviations, metres, > 0
    opacities: Float[Tensor, " N"]  # in [0, 1]
    sh: Float[Tensor, "N K 3"]  # spherical-harmonics colour coefficients, K = (degree + 1)^2 in 1, 4, 9, 16


class FeatureGaussians(NamedTuple):
    """`Gaussians` with C values each in place of a colour."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    features: Float[Tensor, "N C"]


class Rendering(NamedTuple):
    """A splatted image. `image` holds the background already; `alpha` is 1 - transmittance."""

    image: Float[Tensor, "H W C"]  # C = 3 unless features were splatted
    alpha: Float[Tensor, "H W"]

    def numpy(self) -> UInt8[np.ndarray, "H W C"]:
        """The image in 8 bits, 255 for 1 and above."""
        return to_8_bit(self.image).cpu().numpy()

    def png(self) -> bytes:
        """The image as a PNG file. Raises ValueError for features."""
        import cv2

        if self.image.shape[-1] != 3:
            raise ValueError(f"{self.image.shape[-1]} features are no picture")
        return cv2.imencode(".png", cv2.cvtColor(self.numpy(), cv2.COLOR_RGB2BGR))[1].tobytes()

    def _repr_png_(self) -> bytes:
        return self.png()
