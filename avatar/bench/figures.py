"""How an avatar draws some frames, inside their head masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.frame import Frame
from avatar.evaluation.measure import lpips_in_mask
from avatar.gaussians.base_model import Avatar
from avatar.losses.lpips_network import Lpips
from avatar.losses.metrics import psnr, ssim
from avatar.render import Renderer
from avatar.tensors import to_8_bit
from avatar.types import Camera, HeadParams


@dataclass(frozen=True)
class Figures:
    """Means over frames of 8-bit pictures."""

    psnr: float  # dB
    ssim: float
    lpips: float  # NaN without a network


@torch.no_grad()
def head_figures(
    avatar: Avatar,
    background: Float[Tensor, " 3"],
    driven: Sequence[tuple[HeadParams, Camera, Frame]],
    network: Lpips | None = None,
) -> Figures:
    """Of the avatar driven by head parameters before a camera, against the pictures of these frames."""
    renders = Renderer(avatar, background).stream((params, camera) for params, camera, _ in driven)
    found = []
    for rendering, (_, _, frame) in zip(renders, driven, strict=True):
        images = [to_8_bit(p).double() / 255 for p in (rendering.image, frame.composite(background))]
        pair, mask = (images[0], images[1]), frame.head_mask.double()
        found.append((float(psnr(*pair, mask)), float(ssim(*pair, mask)), lpips_in_mask(network, pair, mask)))
    return Figures(*np.mean(found, axis=0).tolist())
