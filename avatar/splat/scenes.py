"""The scene that the splatter is measured on: splats on the surface of something of a head's size."""

from __future__ import annotations

import math

import torch

from avatar.types import Camera, Gaussians

HEAD_SPLATS = 14_876  # of a FlashAvatar with the paper's 128 x 128 texture
SEMI_AXES = (0.075, 0.11, 0.095)  # metres


def head_shell(count: int = HEAD_SPLATS, *, seed: int = 0) -> Gaussians:
    """`count` splats on a bumpy ellipsoid around the origin, the same for the same seed; colours of degree 3.

    Scales come from the spacing of the splats. Opacities spread over the whole range, half of them between 0.38 and 0.82,
    so that a pixel takes several splats to fill, as on a trained avatar.
    """
    g = torch.Generator().manual_seed(seed)
    i = torch.arange(count, dtype=torch.float64) + 0.5
    polar, azimuth = torch.acos(1 - 2 * i / count), math.pi * (1 + math.sqrt(5)) * i  # Fibonacci's lattice
    unit = torch.stack((azimuth.cos() * polar.sin(), polar.cos(), azimuth.sin() * polar.sin()), -1).float()
    spacing = sum(SEMI_AXES) / 3 * math.sqrt(4 * math.pi / count)
    return Gaussians(
        means=torch.tensor(SEMI_AXES) * unit * (1 + 0.08 * torch.sin(7 * unit[:, :1]))
        + 0.0015 * torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        scales=spacing * torch.exp(0.35 * torch.randn(count, 3, generator=g)),
        opacities=torch.sigmoid(1.5 * torch.randn(count, generator=g) + 0.5),
        sh=0.1 * torch.randn(count, 16, 3, generator=g),
    )


def head_camera(size: int) -> Camera:
    """A square camera of `size` pixels, 0.75 m in front of the head, which fills two thirds of the image's height."""
    return Camera(torch.eye(3), torch.tensor([0.0, 0.0, 0.75]), 2.2 * size, 2.2 * size, size / 2, size / 2, size, size)
