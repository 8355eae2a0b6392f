"""N-dimensional Gaussians (NDGS) in the place of FlashAvatar's offsets: what HyperGaussians are compared with.

Each Gaussian is one normal distribution over (position a, latent b) of 3 + n values, of which a splat is a slice:

    position   E[a | b] = mu_a + Sigma_ab Sigma_bb^-1 (b - mu_b)
    shape      Cov[a | b] = Sigma_aa - Sigma_ab Sigma_bb^-1 Sigma_ba, the same for every b
    opacity    times the joint density at (E[a | b], b) over its peak, exp(-(b - mu_b)^T Sigma_bb^-1 (b - mu_b) / 2)

Source: Diolatzis et al., N-Dimensional Gaussians (2024), as HyperGaussians (CVPR 2026, section 3, "Bayesian
Interpretation", and supplement, "Comparison with NDGS") describes it inside FlashAvatar.

Sigma is stored by its block Cholesky factor with the latent first. Every covariance has one:

    Sigma_bb = B B^T      Sigma_ab = A B^T      Sigma_aa = A A^T + (R S)(R S)^T

with B lower triangular (n x n, diagonal through exp), A any 3 x n matrix and R S the Gaussian's own rotation and scales.
So the conditional covariance is R S^2 R^T: it keeps FlashAvatar's parameters, start and learning rates, needs no
eigenvectors, whose gradients have no value for a sphere, and with w = B^-1 (b - mu_b) all else is one substitution:
position mu_a + A w, density exp(-|w|^2 / 2).

Gaussians lie last, so that each step of the substitution is one operation on contiguous rows of all of them.
"""

from __future__ import annotations

from copy import deepcopy
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.baselines.covariance import triangle_size
from avatar.model import FlashAvatar
from avatar.tensors import take_rows
from avatar.types import Gaussians


class Slice(NamedTuple):
    """What the latent decides of a splat."""

    position: Float[Tensor, "N 3"]  # metres, relative to the point on the mesh
    density: Float[Tensor, " N"]  # in (0, 1]: the opacity's factor


class NdGaussians(nn.Module):
    """N Gaussians over (position, latent of n values); all parameters 0 at the start."""

    def __init__(self, num_gaussians: int, latent_size: int) -> None:
        super().__init__()
        self.latent_size = latent_size
        self.mean = nn.Parameter(torch.zeros(3 + latent_size, num_gaussians))  # of the position, then of the latent
        self.root = nn.Parameter(torch.zeros(triangle_size(latent_size), num_gaussians))  # B, row by row
        self.cross = nn.Parameter(torch.zeros(3, latent_size, num_gaussians))  # A

    def forward(self, latents: Float[Tensor, "M n"], rows: Int[Tensor, " M"] | None = None) -> Slice:
        """`rows` are the Gaussians of the latents; None: all of them."""
        parts = self.mean, self.root, self.cross
        mean, root, cross = parts if rows is None else (take_rows(part, rows, -1) for part in parts)
        mean_a, mean_b = mean.split((3, self.latent_size))
        whitened = substitute(root, latents.T - mean_b)
        position = mean_a + (cross * whitened).sum(dim=1)
        return Slice(position.T, torch.exp(-0.5 * whitened.square().sum(dim=0)))

    def fold(self) -> Self:
        """There is nothing to be computed once."""
        return deepcopy(self)


def substitute(triangle: Float[Tensor, "T N"], right: Float[Tensor, "n N"]) -> Float[Tensor, "n N"]:
    """w with B w = right. `triangle` holds B row by row: the strictly lower part as it is, the diagonal through exp."""
    n = len(right)
    solved: list[Tensor] = []
    for row, value in zip(triangle.split(list(range(1, n + 1))), right.unbind(), strict=True):
        if solved:
            value = value - (row[:-1] * torch.stack(solved)).sum(dim=0)
        solved.append(value * torch.exp(-row[-1]))
    return torch.stack(solved)


class NdgsAvatar(FlashAvatar):
    heads = NdGaussians
    is_fused = False
    without_effect = ("upsampling",)
    unknown_to_browsers = "its opacities"

    def offsets(self, latents: Float[Tensor, "N n"]) -> Slice:
        assert self.hyper is not None
        return self.hyper(latents)

    def apply_offsets(self, points: Float[Tensor, "N 3"], offsets: Slice) -> Gaussians:
        """Gaussians that move, through tanh as FlashAvatar's do, and fade; they do not turn or grow."""
        quats, log_scales, opacity_logits, sh = self.base()
        means, opacities = points + torch.tanh(offsets.position), torch.sigmoid(opacity_logits) * offsets.density
        return Gaussians(means, normalize(quats, dim=-1), torch.exp(log_scales), opacities, sh)
