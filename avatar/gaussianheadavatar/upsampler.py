"""The network that turns a splatted image of features into a colour image of 1, 2 or 4 times its size.

Source: Xu et al., Gaussian Head Avatar (CVPR 2024), super-resolution.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import batch_norm, interpolate

CAPACITY = 4  # times as many channels at the small size


class DoubleConvolution(nn.Module):
    """Twice: a 3x3 convolution without bias, each channel to mean 0 and variance 1, ReLU."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        pair = nn.Conv2d(before, after, 3, padding=1, bias=False), nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.convolutions = nn.ModuleList(pair)

    def forward(self, image: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 D H W"]:
        for convolution in self.convolutions:
            image = convolution(image)
            # Instance norm, as there is one image. Unlike instance_norm it keeps the order in memory, and backward it
            # takes a third of the time of group_norm.
            image = torch.relu_(batch_norm(image, None, None, training=True))
        return image


class Upsampler(nn.Module):
    """Features [H, W, channels] to colours [factor H, factor W, 3] between 0 and 1.

    At the small size there are 4 x `channels` channels, and every doubling of the size halves them. The factor is 1, 2
    or 4.
    """

    def __init__(self, channels: int = 32, factor: int = 4) -> None:
        super().__init__()
        self.factor = factor
        wide = CAPACITY * channels
        halvings = [DoubleConvolution(wide >> i, wide >> (i + 1)) for i in range(factor.bit_length() - 1)]
        self.stages = nn.ModuleList((DoubleConvolution(channels, wide), *halvings))
        self.colour = nn.Conv2d(wide // factor, 3, 1)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, image: Float[Tensor, "H W C"]) -> Float[Tensor, "fH fW 3"]:
        """H and W of at least 2."""
        x = image.permute(2, 0, 1)[None]  # a view, with the channels last in memory
        for i, stage in enumerate(self.stages):
            if i > 0:
                x = interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = stage(x)
        return torch.sigmoid(self.colour(x))[0].permute(1, 2, 0)
