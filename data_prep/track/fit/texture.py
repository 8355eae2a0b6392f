"""Skin points' own grey values, and the light in which each frame shows them.

A lamp that stays where it is lights another side of a head that turns. What light from afar does to a matt surface is, to
the first order of spherical harmonics, linear in the surface's normal (Basri and Jacobs, "Lambertian reflectance and linear
subspaces", 2003), so that a frame has a gain and a slope by the normal: four numbers, whatever its lamps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.normals import vertex_normals
from data_prep.track.fit.photometric_term import DEVIATION, ROBUST

_ROUNDS = 6
_SLOPE_DEVIATION = 0.3  # of the gain, by one unit of the normal: keeps few points from making up a light


class LitTexture(NamedTuple):
    """The value of point n in frame t is its texture times `light`[t] . basis[n]."""

    texture: Float[Tensor, " N"]
    light: Float[Tensor, "T B"]  # its first column is 1 in the mean, the others 0

    def values(self, basis: Float[Tensor, "N B"]) -> Float[Tensor, "T N"]:
        """What the frames show, of the points whose `basis` the texture was made with."""
        return (self.light @ basis.T) * self.texture


def light_basis(
    assets: HeadAssets, corners: Int[Tensor, "N 3"], barycentric: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 4"]:
    """1, and the unit normals of the resting head at points of it, less their mean: a light is given in the head's axes."""
    normals = vertex_normals(assets.template.double(), assets.faces)
    own = torch.nn.functional.normalize((normals[corners] * barycentric[..., None]).sum(1), dim=-1)
    return torch.cat((own.new_ones(len(own), 1), own - own.mean(0)), dim=1)


def lit_texture(values: Float[Tensor, "T N"], weights: Float[Tensor, "T N"], basis: Float[Tensor, "N B"]) -> LitTexture:
    """The texture and the light whose products are nearest to `values`; the first column of `basis` is 1.

    Alternating weighted least squares, reweighted for Cauchy's loss. Unseen points are 0.
    """
    T, B = len(values), basis.shape[1]
    light = torch.nn.functional.one_hot(values.new_zeros(T, dtype=torch.int64), B).to(values)
    prior = torch.diag(torch.tensor([1e-9] + [(DEVIATION / _SLOPE_DEVIATION) ** 2] * (B - 1)).to(values))
    products = (basis[:, :, None] * basis[:, None]).flatten(1)  # [N, B B]
    robust = weights
    texture = values.new_zeros(values.shape[1])
    for _ in range(_ROUNDS):
        field = light @ basis.T
        texture = (robust * field * values).sum(0) / (robust * field**2).sum(0).clamp(min=1e-9)
        hessian = ((robust * texture**2) @ products).unflatten(1, (B, B)) + prior
        light = torch.linalg.solve(hessian, (robust * texture * values) @ basis)
        light = torch.cat(
            (light[:, :1] / light[:, :1].mean().clamp(min=1e-9), light[:, 1:] - light[:, 1:].mean(0)), dim=1
        )
        residuals = (values - (light @ basis.T) * texture) / DEVIATION
        robust = weights / (1 + (residuals / ROBUST) ** 2)
    return LitTexture(texture, light)
