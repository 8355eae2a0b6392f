"""Five sets of HyperGaussians: the networks' latents decide position, colour, rotation, scale and opacity.

Each is a joint normal distribution over (attribute a of m values, latent b of n), whose mean given the latent z is

    E[a | z] = mu_a - L11^-T L21^T (z - mu_b)

as `avatar.gaussians.hyper` derives it. Stored per Gaussian: the means (m + n), L11 as its m (m + 1) / 2 values row by
row, with the logarithm of the diagonal, and L21 (n m). All are 0 at the start, so the first output is 0 whatever z.

Gaussians lie last, so that each step of a substitution is one operation on contiguous rows of all of them: an L11 of 32
x 32 as a square, solved Gaussian by Gaussian, takes twice the memory and several times as long.

Source: HyperGaussians (CVPR 2026), section 3, and its supplement on Gaussian Head Avatar.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from avatar.tensors import take_rows


class Attributes(NamedTuple):
    """What the five latents decide, in the place of the networks' own outputs."""

    position: Float[Tensor, "N 3"]
    colour: Float[Tensor, "N C"]
    rotation: Float[Tensor, "N 4"]
    scale: Float[Tensor, "N 3"]
    opacity: Float[Tensor, "N 1"]
    density: Float[Tensor, " N"] | None = None  # a factor of the opacity


def triangle_rows(triangle: Float[Tensor, "T N"], m: int) -> tuple[Tensor, ...]:
    """The rows of a lower triangle of size m, views of 1, 2, ... m values."""
    return triangle.split(list(range(1, m + 1)))


class _Pull(torch.autograd.Function):
    """L11^-T L21^T d for all Gaussians, without a square matrix and with nothing kept but the solution."""

    @staticmethod
    def forward(
        ctx: Any, offset: Float[Tensor, "n N"], lower: Float[Tensor, "T N"], cross: Float[Tensor, "n m N"]
    ) -> Float[Tensor, "m N"]:
        x = torch.zeros_like(cross[0])
        for of_latent, d in zip(cross, offset, strict=True):
            x.addcmul_(of_latent, d)
        for j, row in reversed([*enumerate(triangle_rows(lower, len(x)))]):
            x[j] *= torch.exp(-row[j])
            x[:j].addcmul_(row[:j], x[j], value=-1)
        ctx.save_for_backward(offset, lower, cross, x)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # pyright: ignore
        offset, lower, cross, x = ctx.saved_tensors
        y = torch.empty_like(x)  # L11 y = grad: the gradient of the right-hand side
        grad_lower = torch.empty_like(lower)
        rows = zip(triangle_rows(lower, len(x)), triangle_rows(grad_lower, len(x)), strict=True)
        for i, (row, grad_row) in enumerate(rows):
            y[i] = (grad[i] - (row[:i] * y[:i]).sum(dim=0)) * torch.exp(-row[i])
            torch.mul(y[: i + 1], -x[i], out=grad_row)
            grad_row[i] *= torch.exp(row[i])
        grad_offset = torch.stack([(of_latent * y).sum(dim=0) for of_latent in cross])
        return grad_offset, grad_lower, offset[:, None] * y


class HyperSet(nn.Module):
    """The HyperGaussians of one attribute of m values, with n latent dimensions."""

    def __init__(self, num_gaussians: int, attribute_size: int, latents: int) -> None:
        super().__init__()
        m, N = attribute_size, num_gaussians
        self.attribute_size = m
        self.mean = nn.Parameter(torch.zeros(m + latents, N))  # of the attribute, then of the latent
        self.lower = nn.Parameter(torch.zeros(m * (m + 1) // 2, N))
        self.cross = nn.Parameter(torch.zeros(latents, m, N))

    def forward(self, latents: Float[Tensor, "M n"], rows: Int[Tensor, " M"] | None = None) -> Float[Tensor, "M m"]:
        """`rows` are the Gaussians of the latents; None: all of them."""
        parts = self.mean, self.lower, self.cross
        mean, lower, cross = parts if rows is None else (take_rows(part, rows, -1) for part in parts)
        mean_a, mean_b = mean[: self.attribute_size], mean[self.attribute_size :]
        return (mean_a - _Pull.apply(latents.T - mean_b, lower, cross)).T  # pyright: ignore


class HyperSets(nn.Module):
    """The five sets."""

    def __init__(self, num_gaussians: int, channels: int, latents: int) -> None:
        super().__init__()
        self.latents = latents
        self.position, self.colour, self.rotation, self.scale, self.opacity = (
            HyperSet(num_gaussians, m, latents) for m in (3, channels, 4, 3, 1)
        )

    def forward(
        self, deformation: Float[Tensor, "N n"], colour: Float[Tensor, "N n"], attributes: Float[Tensor, "N A"]
    ) -> Attributes:
        """`attributes` holds three latents side by side: of the rotation, the scale and the opacity."""
        rotation, scale, opacity = attributes.split(self.latents, dim=1)
        return Attributes(
            self.position(deformation),
            self.colour(colour),
            self.rotation(rotation),
            self.scale(scale),
            self.opacity(opacity),
        )

    @torch.no_grad()
    def start_colour(self, values: Float[Tensor, "N C"]) -> None:
        """Let these be the colours at the start."""
        self.colour.mean[: self.colour.attribute_size] = values.T
