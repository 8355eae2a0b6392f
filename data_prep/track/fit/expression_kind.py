"""What a head model's expression coefficients are like, where nothing says so."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from avatar.head.assets import HeadAssets

_ORTHOGONAL = 0.1  # largest cosine between two directions of a statistical basis


def used_expressions(assets: HeadAssets) -> Int[Tensor, " E"]:
    """The coefficients that move anything."""
    return torch.nonzero((assets.expression_dirs != 0).any(0).any(0)).squeeze(1)


def is_statistical(assets: HeadAssets) -> bool:
    """True for principal components (FLAME's: unit variance, both signs), False for blendshapes (0 to 1).

    Principal components are orthogonal to each other; blendshapes, which move the same muscles, are not.
    """
    directions = assets.expression_dirs[:, :, used_expressions(assets)].double().flatten(0, 1)
    if directions.shape[1] < 2:
        return False
    unit = directions / directions.norm(dim=0)
    cosines = unit.T @ unit - torch.eye(unit.shape[1], dtype=torch.float64)
    return bool(cosines.abs().max() < _ORTHOGONAL)
