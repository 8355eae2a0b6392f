"""HyperGaussians through their covariance: what `avatar.gaussians.hyper` holds, parametrised and conditioned naively.

Each Gaussian holds, per attribute of dimension m, the mean of (attribute a, latent b), m + n values, and the lower
Cholesky factor L of their covariance, Sigma = L L^T. Then

    E[a | b]   = mu_a + Sigma_ab Sigma_bb^-1 (b - mu_b)        Cov[a | b] = Sigma_aa - Sigma_ab Sigma_bb^-1 Sigma_ba

Source: HyperGaussians (CVPR 2026), section 3, the conditioning before the inverse covariance trick; supplement,
"Parameterization" (diagonal through exp). It is there to be compared with: Sigma_bb, n x n, is built and factorised for
every Gaussian, so the time grows with n^3 and the parameters with (m + n)^2. Float32 loses figures where Sigma is badly
conditioned (docs/bench/kernels.md).

Gaussians lie last, so that each step of a factorisation is one operation on contiguous rows of all of them.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from avatar.compute.memory import Need
from avatar.config import ModelConfig
from avatar.gaussians.hyper import FoldedHeads
from avatar.gaussians.hyper_cpu import HEADS
from avatar.model import FlashAvatar


def triangle_size(size: int) -> int:
    """Entries of a lower triangle with `size` rows."""
    return size * (size + 1) // 2


def dense_factor(factor: Float[Tensor, "T N"], size: int) -> Float[Tensor, "size size N"]:
    """L from its lower triangle, row by row: the strictly lower part as it is, the diagonal through exp."""
    L = factor.new_zeros(size, size, factor.shape[1])
    for i, row in enumerate(factor.split(list(range(1, size + 1)))):
        L[i, : i + 1] = row
        L[i, i].exp_()
    return L


def conditional_mean(
    mean: Float[Tensor, "d N"], factor: Float[Tensor, "T N"], latents: Float[Tensor, "n N"]
) -> Float[Tensor, "m N"]:
    """mu_a + Sigma_ab Sigma_bb^-1 (z - mu_b), differentiable once in everything.

    factor  the lower triangle of L, row by row, T = d (d + 1) / 2 with d = m + n
    """
    return _ConditionalMean.apply(mean, factor, latents)  # pyright: ignore


class _ConditionalMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, mean: Tensor, factor: Tensor, latents: Tensor) -> Tensor:
        n = len(latents)
        m = len(mean) - n
        L = dense_factor(factor, m + n)
        root = latent_root(L[m:])
        solved = solve_with_root(root, latents - mean[m:])
        pulled = _rows_times(L[m:, :m], solved)  # Sigma_ab = L_aa L_ba^T: a comes first in the triangle
        ctx.save_for_backward(L, root, solved, pulled)
        return mean[:m] + _times_rows(L[:m, :m], pulled)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # pyright: ignore
        L, root, solved, pulled = ctx.saved_tensors
        m, n = len(grad), len(solved)
        by_pulled = _rows_times(L[:m, :m], grad)
        by_latents = solve_with_root(root, _times_rows(L[m:, :m], by_pulled))
        # By Sigma_bb the gradient is -by_latents solved^T, a product of two vectors; by L_b its symmetric sum times L_b.
        first, second = _rows_times(L[m:], solved), _rows_times(L[m:], by_latents)
        second[:m] -= by_pulled
        by_factor = grad.new_empty(triangle_size(m + n), grad.shape[1])
        for i, row in enumerate(by_factor.split(list(range(1, m + n + 1)))):
            if i < m:
                torch.mul(grad[i], pulled[: i + 1], out=row)
            else:
                torch.mul(-by_latents[i - m], first[: i + 1], out=row)
                row.addcmul_(solved[i - m], second[: i + 1], value=-1)
            row[-1] *= L[i, i]
        return torch.cat((grad, -by_latents)), by_factor, by_latents


def _rows_times(matrix: Float[Tensor, "r c N"], vector: Float[Tensor, "r N"]) -> Float[Tensor, "c N"]:
    """matrix^T vector of each Gaussian."""
    found = matrix[0] * vector[0]
    for i in range(1, len(vector)):
        found.addcmul_(matrix[i], vector[i])
    return found


def _times_rows(matrix: Float[Tensor, "r c N"], vector: Float[Tensor, "c N"]) -> Float[Tensor, "r N"]:
    """matrix vector of each Gaussian."""
    return _rows_times(matrix.transpose(0, 1), vector)


def latent_root(of_latent: Float[Tensor, "n d N"]) -> Float[Tensor, "n n N"]:
    """The Cholesky factor of Sigma_bb, from the rows of L that belong to the latent. Above its diagonal: anything."""
    n, columns, N = of_latent.shape
    S = of_latent.new_zeros(n, n, N)
    for k in range(columns):
        begin = max(0, k - (columns - n))  # rows above have a zero there
        column = of_latent[begin:, k]
        for i in range(n - begin):
            S[begin + i, begin : begin + i + 1].addcmul_(column[: i + 1], column[i])
    for j in range(n):
        S[j, j].sqrt_()
        S[j + 1 :, j] /= S[j, j]
        for i in range(j + 1, n):
            S[i, j + 1 : i + 1].addcmul_(S[j + 1 : i + 1, j], S[i, j], value=-1)
    return S


def solve_with_root(root: Float[Tensor, "n n N"], right: Float[Tensor, "n N"]) -> Float[Tensor, "n N"]:
    """x with R R^T x = right, R lower triangular: forward, then back substitution."""
    x = right.clone()
    for j in range(len(x)):
        x[j] /= root[j, j]
        x[j + 1 :].addcmul_(root[j + 1 :, j], x[j], value=-1)
    for j in reversed(range(len(x))):
        x[j] /= root[j, j]
        x[:j].addcmul_(root[j, :j], x[j], value=-1)
    return x


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
        L, m = dense_factor(self.factor.detach().double(), len(self.mean)).permute(2, 0, 1), self.attribute_size
        sigma = L @ L.mT
        return torch.linalg.solve(sigma[:, m:, m:], sigma[:, m:, :m]).mT


class CovarianceHeads(nn.Module):
    """Three independent heads on one latent: position (3), rotation (4) and scale (3); in place of `HyperHeads`."""

    def __init__(self, num_gaussians: int, latent_size: int) -> None:
        super().__init__()
        if latent_size < 1:
            raise ValueError(f"a HyperGaussian needs at least one latent dimension, got {latent_size}")
        for name, m in HEADS.items():
            self.add_module(name, CovarianceHead(num_gaussians, m, latent_size))

    def heads(self) -> dict[str, CovarianceHead]:
        return {name: self.get_submodule(name) for name in HEADS}  # type: ignore[dict-item]

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """The raw offsets."""
        rows = latents.T.contiguous()
        return torch.cat([head(rows) for head in self.heads().values()]).T.contiguous()

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

    @classmethod
    def step_needs(cls, config: ModelConfig, gaussians: int, size: tuple[int, int]) -> list[Need]:
        """Of each head: the factor as a square, and that of the latent's block."""
        squares = sum((m + config.latent_dim) ** 2 + config.latent_dim**2 for m in HEADS.values())
        return [Need("the covariances", 4 * gaussians * squares, "model.uv_size or model.latent_dim")]
