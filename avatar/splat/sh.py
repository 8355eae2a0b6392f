"""Real spherical harmonics of degree 0 to 3, in the order and with the signs of 3D Gaussian splatting files.

Basis functions: C. Green, "Spherical harmonic lighting: the gritty details" (2003), Appendix A2, with the
Condon-Shortley phase; colour = basis @ coefficients + 0.5 and max(., 0) as in Kerbl et al., "3D Gaussian splatting" (2023).
"""

from __future__ import annotations

from math import pi, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
C0 = sqrt(1 / (4 * pi))  # the constant basis function


def sh_degree_of(coefficients: int) -> int:
    """The degree that a number of coefficients stands for: 1, 4, 9, 16 -> 0, 1, 2, 3; ValueError for any other."""
    for degree in range(MAX_DEGREE + 1):
        if (degree + 1) ** 2 == coefficients:
            return degree
    raise ValueError(f"sh must have 1, 4, 9 or 16 coefficients a channel (degree 0 to 3), got {coefficients}")


def sh_basis(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N K"]:
    """The K = (degree + 1)^2 basis functions at unit vectors."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        c = sqrt(3 / (4 * pi))
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = sqrt(15 / (4 * pi))
        basis += [
            c * x * y,
            -c * y * z,
            sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y),
            -c * x * z,
            0.5 * c * (x * x - y * y),
        ]
    if degree >= 3:
        c33, c32, c31 = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi))
        basis += [
            -c33 * y * (3 * x * x - y * y),
            c32 * x * y * z,
            -c31 * y * (4 * z * z - x * x - y * y),
            sqrt(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c31 * x * (4 * z * z - x * x - y * y),
            0.5 * c32 * z * (x * x - y * y),
            -c33 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)


def sh_colours(sh: Float[Tensor, "N K 3"], directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N 3"]:
    """Colours seen along unit `directions` (from the camera to the splat); coefficients above `degree` are not read.

    The gradient is zero where a channel is clamped at 0.
    """
    basis = sh_basis(directions, degree)
    colours = torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]) + 0.5
    return torch.where(colours > 0, colours, torch.zeros_like(colours))
