"""A set of points that grows: in which order the texels' points begin to take part, and how many there are after each step.

MonoGaussianAvatar (Chen et al., SIGGRAPH 2024) begins with few points, and inserts and removes some while it is trained, as
HyperGaussians (CVPR 2026) describes it. Here a set has its final size in memory from the start, of which the first ones are
alive: so a checkpoint has the shapes that the configuration says, and what is alive is a function of the step.
"""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from avatar.gaussians.uv import UVTexels

DOUBLINGS, EVERY = 4, 0.1  # from 1/16 of the points; each doubling after so large a share of the steps
# Of every 4 x 4 texels, which comes when: each prefix of 1, 2, 4, 8 and 16 is spread evenly (an ordered-dither matrix).
ORDER = ((0, 8, 2, 10), (12, 4, 14, 6), (3, 11, 1, 9), (15, 7, 13, 5))


def alive_after(steps: int, iterations: int, capacity: int) -> int:
    """How many points are alive after so many of a training's steps; at least 1."""
    doublings = min(int(steps / (EVERY * iterations) + 1e-9), DOUBLINGS)
    return max(1, capacity >> (DOUBLINGS - doublings))


def evenly_ordered(texels: UVTexels) -> UVTexels:
    """The texels in an order of which every beginning is spread over the map."""
    rank = torch.tensor(ORDER)[texels.row % 4, texels.column % 4]
    order: Int[Tensor, " N"] = torch.argsort(rank, stable=True)
    return UVTexels(*(values[order] for values in texels))
