"""Random zoom of the training pictures: the same view through a longer or a shorter lens.

Source: Xu et al., Gaussian Head Avatar (CVPR 2024).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.functional import affine_grid, grid_sample

from avatar.config import TrainerConfig
from avatar.data.frame import Frame
from avatar.data.recording import Recording
from avatar.gaussians.base_model import Avatar

_STREAM = 2  # of random numbers, beside those of the frames' order and of the noise


@dataclass(frozen=True)
class Zoom:
    """Uniform between two factors."""

    limits: tuple[float, float]
    seed: int

    def factor(self, step: int) -> float:
        """Of step `step` (from 0): a function of seed and step."""
        return float(np.random.default_rng([self.seed, step, _STREAM]).uniform(*self.limits))


def make_zoom(avatar: Avatar, recording: Recording, config: TrainerConfig) -> Zoom | None:
    """For a training of this model; None where its pictures stay as they are, as those of one camera do."""
    limits = avatar.zoom_limits(config)
    return None if limits is None or recording.rig is None else Zoom(limits, config.seed)


def zoomed(frame: Frame, factor: float) -> Frame:
    """`factor` times as large about the picture's centre, at the picture's size; what is beyond it is white, of no mask
    and not `seen`."""
    camera, masks = frame.camera, (frame.alpha, frame.head_mask, frame.mouth_mask)
    centre_x, centre_y = 0.5 * camera.width, 0.5 * camera.height
    lens = {
        "fx": factor * camera.fx,
        "fy": factor * camera.fy,
        "cx": centre_x + factor * (camera.cx - centre_x),
        "cy": centre_y + factor * (camera.cy - centre_y),
    }
    planes = torch.cat((frame.image.permute(2, 0, 1) - 1.0, torch.stack((*masks, torch.ones_like(frame.alpha)))))[None]
    places = affine_grid(torch.eye(2, 3, device=planes.device)[None] / factor, list(planes.shape), align_corners=False)
    image, (alpha, head, mouth, seen) = grid_sample(planes, places, align_corners=False)[0].split((3, 4))
    return replace(
        frame,
        camera=replace(camera, **lens),
        image=image.permute(1, 2, 0).contiguous() + 1.0,
        alpha=alpha,
        head_mask=head,
        mouth_mask=mouth,
        head_box=None,
        seen=seen > 0.999,  # bilinear weights add up to 1 to rounding
    )
