"""HyperGaussians through their covariance: what `avatar.gaussians.hyper` holds, parametrised and conditioned naively.

Each Gaussian holds, per attribute of dimension m, the mean of (attribute a, latent b), m + n values, and the lower
Cholesky factor L of their covariance, Sigma = L L^T. Then

    E[a | b]   = mu_a + Sigma_ab Sigma_bb^-1 (b - mu_b)        Cov[a | b] = Sigma_aa - Sigma_ab Sigma_bb^-1 Sigma_ba

Source: HyperGaussians (CVPR 2026), section 3, the conditioning before the inverse covariance trick; supplement,
"Parameterization" (diagonal through exp). It is there to be compared with: Sigma_bb, n x n, is built and factorised for
every Gaussian, so the time grows with n^3 and the parameters with (m + n)^2. Float32 loses figures where Sigma is badly
conditioned (docs/bench/kernels.md).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.compute.memory import Need
from avatar.config import ModelConfig
from avatar.gaussians.hyper import FoldedHeads
from avatar.gaussians.hyper_cpu import HEADS
from avatar.model import FlashAvatar


def triangle_size(size: int) -> int:
    """Entries of a lower triangle with `size` rows."""
    return size * (size + 1) // 2


def dense_factor(factor: Float[Tensor, "T N"], size: int) -> Float[Tensor, "N size size"]:
    """L from its lower triangle, row by row: the strictly lower part as it is, the diagonal through exp."""
    rows, columns = torch.tril_indices(size, size, device=factor.device)
    L = factor.new_zeros(factor.shape[1], size, size)
    L[:, rows, columns] = factor.T
    return L.tril(-1) + torch.diag_embed(L.diagonal(dim1=1, dim2=2).exp())


def conditional_mean(
    mean: Float[Tensor, "d N"], factor: Float[Tensor, "T N"], latents: Float[Tensor, "n N"]
) -> Float[Tensor, "m N"]:
    """mu_a + Sigma_ab Sigma_bb^-1 (z - mu_b); not finite where Sigma_bb is singular.

    factor  the lower triangle of L, row by row, T = d (d + 1) / 2 with d = m + n
    """
    m = len(mean) - len(latents)
    L = dense_factor(factor, len(mean))
    sigma = L @ L[:, m:].mT  # the columns of the latent
    solved, _ = torch.linalg.solve_ex(sigma[:, m:], (latents - mean[m:]).T)  # waits for no GPU
    return mean[:m] + (sigma[:, :m] @ solved[..., None]).squeeze(-1).T


class CovarianceHead(nn.Module):
    """The distribution of one attribute (m values) and the latent (n) for N Gaussians; all parameters 0 at the start."""

    def __init__(self, num_gaussians: int, attribute_size: int, latent_size: int) -> None:
        super().__init__()
        size = attribute_size + latent_size
        self.attribute_size = attribute_size
        self.mean = nn.Parameter(torch.zeros(size, num_gaussians))
        self.factor = nn.Parameter(torch.zeros(triangle_size(size), num_gaussians))

    def forward(self, latents: Float[Tensor, "n N"]) -> Float[Tensor, "m N"]:
        return conditional_mean(self.mean, self.factor, latents)

    def slope(self) -> Float[Tensor, "N m n"]:
        """Sigma_ab Sigma_bb^-1 in float64."""
        L, m = dense_factor(self.factor.detach().double(), len(self.mean)), self.attribute_size
        sigma = L @ L.mT
        return torch.linalg.solve(sigma[:, m:, m:], sigma[:, m:, :m]).mT


class CovarianceHeads(nn.Module):
    """Three independent heads on one latent: position (3), rotation (4) and scale (3); in place of `HyperHeads`."""

    def __init__(self, num_gaussians: int, latent_size: int) -> None:
        super().__init__()
        for name, m in HEADS.items():
            self.add_module(name, CovarianceHead(num_gaussians, m, latent_size))

    def heads(self) -> dict[str, CovarianceHead]:
        return {name: self.get_submodule(name) for name in HEADS}  # type: ignore[dict-item]

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """The raw offsets."""
        return torch.cat([head(latents.T) for head in self.heads().values()]).T.contiguous()

    @torch.no_grad()
    def fold(self) -> FoldedHeads:
        """The heads as they are now as one affine map for each Gaussian, solved once in float64."""
        matrices, biases = [], []
        for head in self.heads().values():
            slope, m = head.slope(), head.attribute_size
            mean = head.mean.double().T
            matrices.append(slope.mT)
            biases.append(mean[:, :m] - (slope @ mean[:, m:, None]).squeeze(-1))
        dtype = self.get_parameter("position.mean").dtype
        return FoldedHeads(torch.cat(matrices, dim=-1).to(dtype).contiguous(), torch.cat(biases, dim=-1).to(dtype))


class CovarianceAvatar(FlashAvatar):
    heads = CovarianceHeads
    is_fused = False
    without_effect = ("upsampling",)

    @classmethod
    def step_needs(cls, config: ModelConfig, gaussians: int, size: tuple[int, int]) -> list[Need]:
        """Of each head: the factor as a square, its diagonal and both gradients, and one square more that is free but
        not used again; the latent's columns of the covariance and its block's factors, with theirs."""
        n = config.latent_dim
        squares = sum(5 * (m + n) ** 2 + 2 * (m + n) * n + 2 * n**2 for m in HEADS.values())
        return [Need("the covariances", 4 * gaussians * squares, "model.uv_size or model.latent_dim")]
