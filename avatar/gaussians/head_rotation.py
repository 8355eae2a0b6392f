"""The head's rotation before the camera, as an input of the deformation network.

Lights stay where they are when a head turns, and so do shadows on the neck, reflections on glasses, the collar and the
torso: to the head all of them move. Colours that depend on the view can follow that only texel by texel; what the network
knows can move Gaussians. Three numbers say it: the sines of the head's turn about its own three axes, from how it is turned
on average in training and in units of their spread there. Beyond LIMIT they stand still, because of what training hardly
shows the network makes too much.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

VALUES = 3
LIMIT = 1.5  # root mean squares


def learned_turning(rotations: Float[Tensor, "T 3 3"]) -> Float[Tensor, "3 9"]:
    """What takes the nine entries of a camera's `head_rotation` to how its head is turned; zeros where no head ever turns.

    rotations  of the head before the reference camera, at the times of training
    The skew part of mean^T R holds the sines; it is linear in R.
    """
    U, _, Vh = torch.linalg.svd(rotations.double().mean(dim=0))
    mean = U @ Vh
    sines = torch.zeros(3, 3, 3, dtype=torch.float64)  # of axis, row, column of mean^T R
    for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        sines[axis, i, j], sines[axis, j, i] = 0.5, -0.5
    turning = torch.einsum("aij,ki->akj", sines, mean).reshape(3, 9)
    turns = rotations.double().reshape(-1, 9) @ turning.T
    spread = turns.square().mean().sqrt()
    return (turning * (1.0 / spread if spread > 1e-4 else 0.0)).float()


def head_rotation_input(turning: Float[Tensor, "3 9"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """How the head is turned where the camera's `head_rotation` is `rotation`; differentiable."""
    return (turning @ rotation.reshape(9).to(turning.dtype)).clamp(-LIMIT, LIMIT)
