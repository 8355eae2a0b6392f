"""Positional encoding of places on the neutral mesh."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FREQUENCIES = 8  # FlashAvatar's


def encoded_size(frequencies: int = FREQUENCIES) -> int:
    """Length of the code of a 3D point: itself, then a sine and a cosine of each coordinate at each frequency."""
    return 3 + 3 * 2 * frequencies


def positional_encoding(points: Float[Tensor, "N 3"], frequencies: int = FREQUENCIES) -> Float[Tensor, "N C"]:
    """(x, sin(2^0 x), cos(2^0 x), ..., sin(2^(F-1) x), cos(2^(F-1) x)) with x in metres, C = 3 + 6 F.

    Source: Mildenhall et al., NeRF (2020), eq. 4, without the factor pi, as FlashAvatar uses it.
    """
    parts = [points]
    for k in range(frequencies):
        parts += [torch.sin(points * 2.0**k), torch.cos(points * 2.0**k)]
    return torch.cat(parts, dim=-1)
