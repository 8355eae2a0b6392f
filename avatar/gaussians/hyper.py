"""HyperGaussians: high-dimensional Gaussians whose conditional mean, given a latent, is an attribute of a 3D Gaussian.

Each Gaussian holds, per attribute of dimension m, a joint normal distribution over (attribute a, latent b) of m + n
dimensions through the factor of its precision matrix, Lambda_aa = L11 L11^T and Lambda_ba = L21 L11^T. Then

    E[a | b]   = mu_a - L11^-T L21^T (b - mu_b)          Cov[a | b] = (L11 L11^T)^-1

Source: HyperGaussians (CVPR 2026), section 3 and supplement (the inverse covariance trick); only L11 and L21 are needed.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.gaussians.hyper_cpu import apply_folded, condition


class Factor(NamedTuple):
    """The first m columns of the Cholesky factor of the precision matrix."""

    L11: Float[Tensor, "N m m"]  # lower triangular, positive diagonal
    L21: Float[Tensor, "N n m"]


def factor_of(lower: Float[Tensor, "N m m"], cross: Float[Tensor, "N n m"]) -> Factor:
    """The factor from a head's parameters: the strictly lower part as it is, the diagonal through exp."""
    log_diagonal = torch.diagonal(lower, dim1=-2, dim2=-1)
    return Factor(torch.tril(lower, diagonal=-1) + torch.diag_embed(torch.exp(log_diagonal)), cross)


def conditional_mean(
    mean_a: Float[Tensor, "N m"],
    mean_b: Float[Tensor, "N n"],
    factor: Factor,
    latents: Float[Tensor, "N n"],
) -> Float[Tensor, "N m"]:
    """mu_a - L11^-T L21^T (z - mu_b): a product with an n x m matrix, then a triangular solve of size m."""
    pulled = torch.einsum("gnm,gn->gm", factor.L21, latents - mean_b)
    solved = _solve_upper(factor.L11, pulled)
    return mean_a - solved


def _solve_upper(L: Float[Tensor, "N m m"], right: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """x with L^T x = right, by back substitution over the m columns (m is 3 or 4, N is thousands)."""
    m = L.shape[-1]
    solution: list[Tensor] = [right.new_empty(0)] * m
    for i in reversed(range(m)):
        value = right[:, i]
        for j in range(i + 1, m):
            value = value - L[:, j, i] * solution[j]
        solution[i] = value / L[:, i, i]
    return torch.stack(solution, dim=-1)


class HyperHead(nn.Module):
    """The HyperGaussians of one attribute (m values) for N Gaussians with n latent dimensions.

    Parameters, all zero at the start: `mean` [N, m + n], `lower` [N, m, m] (strictly lower part as it is, diagonal through
    exp, upper part unused), `cross` [N, n, m]. Their number is N (m + n + m m + n m), as the paper counts them.
    """

    def __init__(self, num_gaussians: int, attribute_size: int, latent_size: int) -> None:
        super().__init__()
        if latent_size < 1:
            raise ValueError(f"a HyperGaussian needs at least one latent dimension, got {latent_size}")
        self.attribute_size, self.latent_size = attribute_size, latent_size
        self.mean = nn.Parameter(torch.zeros(num_gaussians, attribute_size + latent_size))
        self.lower = nn.Parameter(torch.zeros(num_gaussians, attribute_size, attribute_size))
        self.cross = nn.Parameter(torch.zeros(num_gaussians, latent_size, attribute_size))

    def factor(self) -> Factor:
        return factor_of(self.lower, self.cross)

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N m"]:
        mean_a, mean_b = self.mean.split((self.attribute_size, self.latent_size), dim=-1)
        return conditional_mean(mean_a, mean_b, self.factor(), latents)

    def log_det_covariance(self) -> Float[Tensor, " N"]:
        """log det Cov[a | b] = -2 sum(log diag L11), which does not depend on the latent (supplement, eq. 3)."""
        return -2.0 * torch.diagonal(self.lower, dim1=-2, dim2=-1).sum(dim=-1)


class HyperHeads(nn.Module):
    """Three independent heads on one latent: position (3), rotation (4) and scale (3)."""

    def __init__(self, num_gaussians: int, latent_size: int) -> None:
        super().__init__()
        self.position = HyperHead(num_gaussians, 3, latent_size)
        self.rotation = HyperHead(num_gaussians, 4, latent_size)
        self.scale = HyperHead(num_gaussians, 3, latent_size)

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """The raw offsets. Float32 on the CPU goes through one compiled operator, all else through torch's own."""
        heads = self.position, self.rotation, self.scale
        parameters = [tensor for head in heads for tensor in (head.mean, head.lower, head.cross)]
        if all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (latents, *parameters)):
            return condition(latents, parameters)
        return torch.cat((self.position(latents), self.rotation(latents), self.scale(latents)), dim=-1)

    @torch.no_grad()
    def fold(self) -> FoldedHeads:
        """The heads as they are now as one affine map for each Gaussian, solved once in float64."""
        matrices, biases = [], []
        for head in (self.position, self.rotation, self.scale):
            factor = head.factor()
            mean_a, mean_b = head.mean.double().split((head.attribute_size, head.latent_size), dim=-1)
            slope = torch.linalg.solve_triangular(factor.L11.double().mT, factor.L21.double().mT, upper=True)
            matrices.append(-slope.mT)
            biases.append(mean_a + (slope @ mean_b[..., None]).squeeze(-1))
        dtype = self.position.mean.dtype
        return FoldedHeads(torch.cat(matrices, dim=-1).to(dtype).contiguous(), torch.cat(biases, dim=-1).to(dtype))

    def uncertainty(self) -> Float[Tensor, " N"]:
        """The paper's uncertainty, the log-determinants of the conditional covariances summed over the heads."""
        return sum(head.log_det_covariance() for head in (self.position, self.rotation, self.scale))  # type: ignore[return-value]


class FoldedHeads(NamedTuple):
    """Heads that are not trained any more: offsets = bias + latents times matrix, for each Gaussian its own."""

    matrix: Float[Tensor, "N n 10"]
    bias: Float[Tensor, "N 10"]

    def __call__(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """What the heads gave when they were folded, to rounding; no gradients."""
        return apply_folded(self.matrix, self.bias, latents)
