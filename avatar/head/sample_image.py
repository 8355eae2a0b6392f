"""What an image shows at projected points."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def sample_image(image: Float[Tensor, "H W C"], screen: Float[Tensor, "N _"], mode: str) -> Float[Tensor, "N C"]:
    """The image's values at points (x pixel, y pixel, ...), `mode` "nearest" or "bilinear"; zero outside the image."""
    height, width = image.shape[:2]
    grid = screen[:, :2] * torch.tensor([2 / width, 2 / height]) - 1
    # A point in the camera's plane is not in the image.
    grid = grid.nan_to_num(nan=-9.0).clamp(-9, 9)
    picked = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid[None, :, None], mode=mode, padding_mode="zeros", align_corners=False
    )
    return picked[0, :, :, 0].T
