"""The camera's pose as the kernels take it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import to_device
from avatar.types import Camera


def pose_of(camera: Camera, device: torch.device) -> Float[Tensor, " 12"]:
    """R_cam_world, row by row, and t_cam_world, float64 on `device`; differentiable."""
    R, t = (to_device(part, device) for part in (camera.R_cam_world, camera.t_cam_world))
    return torch.cat((R.reshape(9), t)).double()
