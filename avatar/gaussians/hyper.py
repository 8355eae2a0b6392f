"""HyperGaussians: high-dimensional Gaussians whose conditional mean, given a latent, is an attribute of a 3D Gaussian.

Each Gaussian holds, per attribute of dimension m, a joint normal distribution over (attribute a, latent b) of m + n
dimensions through the factor of its precision matrix, Lambda_aa = L11 L11^T and Lambda_ba = L21 L11^T. Then

    E[a | b]   = mu_a - L11^-T L21^T (b - mu_b)          Cov[a | b] = (L11 L11^T)^-1

Source: HyperGaussians (CVPR 2026), section 3 and supplement (the inverse covariance trick); only L11 and L21 are needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar import _core
from avatar.gaussians.hyper_cpu import BLOCK, CONSTANTS, DIMENSION, HEADS, apply_folded, condition, packed_shape


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


class HyperHead(NamedTuple):
    """The HyperGaussians of one attribute (m values) for N Gaussians with n latent dimensions."""

    mean: Float[Tensor, "N m+n"]  # of the attribute, then of the latent
    lower: Float[Tensor, "N m m"]  # strictly lower part as it is, diagonal through exp, upper part unused
    cross: Float[Tensor, "N n m"]

    def factor(self) -> Factor:
        return factor_of(self.lower, self.cross)

    def means(self) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N n"]]:
        mean_a, mean_b = self.mean.split((self.cross.shape[2], self.cross.shape[1]), dim=-1)
        return mean_a, mean_b

    def conditional_mean(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N m"]:
        return conditional_mean(*self.means(), self.factor(), latents)

    def log_det_covariance(self) -> Float[Tensor, " N"]:
        """log det Cov[a | b] = -2 sum(log diag L11), which does not depend on the latent (supplement, eq. 3)."""
        return -2.0 * torch.diagonal(self.lower, dim1=-2, dim2=-1).sum(dim=-1)


Heads = dict[str, HyperHead]  # by the names in HEADS


def pack(heads: Heads) -> Float[Tensor, "blocks rows 16"]:
    """All heads in the order in which the compiled operator reads them: 16 Gaussians side by side in each row.

    Rows of a block: the attributes' means; the factors' lower triangles, row by row; then for every latent dimension and
    head the latent's mean and the m values of the cross term. The last block is filled up with zeros.
    """
    parts = [head.means()[0] for head in heads.values()]
    parts += [head.lower[(slice(None), *_triangle(m))] for head, m in zip(heads.values(), HEADS.values(), strict=True)]
    dimensions = [part for head in heads.values() for part in (head.means()[1][..., None], head.cross)]
    values = torch.cat((*parts, torch.cat(dimensions, dim=-1).flatten(1)), dim=-1)
    filled = nn.functional.pad(values, (0, 0, 0, -len(values) % BLOCK))
    return filled.unflatten(0, (-1, BLOCK)).transpose(1, 2).contiguous()


def unpack(packed: Float[Tensor, "blocks rows 16"], num_gaussians: int) -> Heads:
    """The inverse of `pack`, differentiable."""
    values = packed.transpose(1, 2).flatten(0, 1)[:num_gaussians]
    sizes = tuple(HEADS.values())
    means, triangles, dimensions = values.split(
        (sum(sizes), CONSTANTS - sum(sizes), values.shape[1] - CONSTANTS), dim=1
    )
    by_head = zip(
        HEADS.items(),
        means.split(sizes, dim=1),
        triangles.split([m * (m + 1) // 2 for m in sizes], dim=1),
        dimensions.unflatten(1, (-1, DIMENSION)).split([1 + m for m in sizes], dim=2),
        strict=True,
    )
    heads: Heads = {}
    for (name, m), mean_a, triangle, of_latent in by_head:
        lower = values.new_zeros(num_gaussians, m, m)
        lower[(slice(None), *_triangle(m))] = triangle
        heads[name] = HyperHead(torch.cat((mean_a, of_latent[..., 0]), dim=1), lower, of_latent[..., 1:])
    return heads


def _triangle(m: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of a lower triangle, row by row."""
    rows, columns = torch.tril_indices(m, m)
    return rows, columns


class HyperHeads(nn.Module):
    """Three independent heads on one latent: position (3), rotation (4) and scale (3). All parameters are 0 at the start.

    They are one tensor, `packed`. A state dict holds them as position.mean, position.lower, position.cross and so on, so
    what is on disk does not depend on the order in memory.
    """

    def __init__(self, num_gaussians: int, latent_size: int) -> None:
        super().__init__()
        self.num_gaussians, self.latent_size = num_gaussians, latent_size
        packed = torch.zeros(packed_shape(num_gaussians, latent_size))
        if packed.dtype is torch.float32 and packed.is_cpu:
            packed = _core.large_tensor(packed.shape).zero_()
        self.packed = nn.Parameter(packed)

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """The raw offsets. Float32 on the CPU goes through one compiled operator, all else through torch's own."""
        packed = self.packed
        if latents.dtype is packed.dtype is torch.float32 and latents.is_cpu and packed.is_cpu:
            return condition(latents, packed)
        return torch.cat([head.conditional_mean(latents) for head in self.heads().values()], dim=-1)

    def heads(self) -> Heads:
        """The parameters of each head by its name, differentiable copies."""
        return unpack(self.packed, self.num_gaussians)

    @torch.no_grad()
    def set_heads(self, heads: Heads) -> None:
        """Take these parameters; ValueError where they are of another size."""
        packed = pack(heads)
        if packed.shape != self.packed.shape or len(heads["position"].mean) != self.num_gaussians:
            raise ValueError(
                f"the heads must be of {self.num_gaussians} Gaussians and {self.latent_size} latent dimensions"
            )
        self.packed.copy_(packed)

    @torch.no_grad()
    def fold(self) -> FoldedHeads:
        """The heads as they are now as one affine map for each Gaussian, solved once in float64."""
        matrices, biases = [], []
        for head in self.heads().values():
            factor = head.factor()
            mean_a, mean_b = (mean.double() for mean in head.means())
            slope = torch.linalg.solve_triangular(factor.L11.double().mT, factor.L21.double().mT, upper=True)
            matrices.append(-slope.mT)
            biases.append(mean_a + (slope @ mean_b[..., None]).squeeze(-1))
        dtype = self.packed.dtype
        return FoldedHeads(torch.cat(matrices, dim=-1).to(dtype).contiguous(), torch.cat(biases, dim=-1).to(dtype))

    def uncertainty(self) -> Float[Tensor, " N"]:
        """The paper's uncertainty, the log-determinants of the conditional covariances summed over the heads."""
        return torch.stack([head.log_det_covariance() for head in self.heads().values()]).sum(dim=0)

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        packed = self.packed if keep_vars else self.packed.detach()
        for name, head in unpack(packed, self.num_gaussians).items():
            destination |= {f"{prefix}{name}.{part}": value for part, value in head._asdict().items()}

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        own: dict[str, Any] = {}
        self._save_to_state_dict(own, prefix, False)
        _, _, missing, unexpected, errors = rest
        given = {name: value for name, value in state_dict.items() if name.startswith(prefix)}
        missing += own.keys() - given.keys()
        unexpected += given.keys() - own.keys()
        wrong = [name for name in own.keys() & given.keys() if own[name].shape != given[name].shape]
        errors += [f"{name} has shape {list(given[name].shape)}, not {list(own[name].shape)}" for name in wrong]
        if own.keys() <= given.keys() and not wrong:
            parts = {name: [given[f"{prefix}{name}.{part}"] for part in HyperHead._fields] for name in HEADS}
            self.set_heads({name: HyperHead(*values) for name, values in parts.items()})


class FoldedHeads(nn.Module):
    """Heads that are not trained any more: offsets = bias + latents times matrix, for each Gaussian its own."""

    matrix: Float[Tensor, "N n 10"]
    bias: Float[Tensor, "N 10"]

    def __init__(self, matrix: Float[Tensor, "N n 10"], bias: Float[Tensor, "N 10"]) -> None:
        super().__init__()
        self.register_buffer("matrix", matrix)
        self.register_buffer("bias", bias)

    def forward(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """What the heads gave when they were folded, to rounding; no gradients."""
        return apply_folded(self.matrix, self.bias, latents)
