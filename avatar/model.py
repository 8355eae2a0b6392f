"""The method on a page: head parameters -> posed head -> points -> latents -> HyperGaussians -> Gaussians."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.compute.device import on_gpu
from avatar.compute.gpu_functions import gpu_function
from avatar.config import HYPER_RATE, NETWORK_RATE, OPACITY_RATE, ModelConfig, TrainerConfig
from avatar.gaussians.apply_offsets import apply_offsets
from avatar.gaussians.base_model import Groups
from avatar.gaussians.deformation import FoldedNetwork
from avatar.gaussians.encoding import positional_encoding
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.hyper_cpu import OFFSETS
from avatar.gaussians.latent_grid import latent_grid
from avatar.gaussians.skull_binding import INITIAL_LOGIT, Skull, SkullBinding, bind_to_skull
from avatar.gaussians.uv_base_model import UVAvatar
from avatar.head.assets import HeadAssets
from avatar.types import Gaussians, HeadParams


class FlashAvatar(UVAvatar):
    """FlashAvatar: a network gives each Gaussian its offsets from a point on the posed head."""

    heads: ClassVar[type[Any] | None] = None  # made of the numbers of Gaussians and latent values; None: no latents
    is_fused = True
    unknown_to_browsers = None
    without_effect = "upsampling", "latent_dim", "latent_grid"
    code: Tensor  # positional code of the places where the network is evaluated

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__(assets, identity, config)
        places, self.grid = self.neutral_points(), None
        # Offsets are not smooth over the UV map, latents are: only those can be interpolated.
        if self.heads is not None and config.latent_grid is not None:
            self.grid, places = latent_grid(self.mesh.assets, self.embedding.texels, places, config.latent_grid)
        self.register_buffer("code", positional_encoding(places), persistent=False)
        self.skull = None if self.skull_logits is None else Skull.of(self.mesh, self.embedding)

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        super().make_parameters(config, num_expressions, N)
        out_size = OFFSETS if self.heads is None else config.latent_dim
        self.deformation = self.make_network(config, num_expressions, out_size)
        self.hyper = None if self.heads is None else self.heads(N, config.latent_dim)
        self.skull_logits = nn.Parameter(torch.full((N,), INITIAL_LOGIT)) if config.skull_binding else None

    def forward(self, params: HeadParams, vertices=None, rotation=None) -> Gaussians:
        vertices = self.vertices(params) if vertices is None else vertices
        values = self.deformation(self.code, self.condition(params, rotation))
        if self.is_fused and on_gpu(values) and values.dtype == torch.float32:
            packed, binding = None if self.hyper is None else self.hyper.packed, self.skull_binding(params)
            make = gpu_function("make Gaussians")
            return make(vertices, values, packed, *self.base(), self.embedding, self.grid, binding)
        latents = self.interpolate(values)
        return self.apply_offsets(self.points(vertices, params), self.offsets(latents))

    def points(self, vertices: Float[Tensor, "V 3"], params: HeadParams) -> Float[Tensor, "N 3"]:
        """Where the Gaussians are before their offsets, metres: on the posed mesh and, by a share, on the skull."""
        return bind_to_skull(self.embedding.points(vertices), self.skull_binding(params))

    def skull_binding(self, params: HeadParams) -> SkullBinding | None:
        """What brings the points to the skull in a frame."""
        if self.skull is None or self.skull_logits is None:
            return None
        return SkullBinding(self.skull, params.neck, self.skull_logits)

    def interpolate(self, values: Float[Tensor, "M n"]) -> Float[Tensor, "N n"]:
        """The network's values at the Gaussians."""
        return values if self.grid is None else self.grid(values)

    def offsets(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"]:
        """Position, rotation and scale of each Gaussian relative to its point, before the tanh."""
        return latents if self.hyper is None else self.hyper(latents)

    def apply_offsets(self, points: Float[Tensor, "N 3"], offsets: Float[Tensor, "N 10"]) -> Gaussians:
        return apply_offsets(points, *self.base(), offsets)

    def parameter_groups(self, trainer: TrainerConfig) -> Groups:
        groups = super().parameter_groups(trainer)
        if self.skull_logits is not None:
            groups["logits"] = [self.opacity_logits, self.skull_logits], OPACITY_RATE
        groups["network"] = list(self.deformation.parameters()), NETWORK_RATE
        if self.hyper is not None:
            groups["heads"] = list(self.hyper.parameters()), HYPER_RATE
        return groups

    def folded(self) -> dict[Any, Any]:
        folded = {self.embedding: self.embedding.fold(), self.deformation: FoldedNetwork(self.deformation, self.code)}
        if self.hyper is not None and not (self.is_fused and on_gpu(self.quats)):
            folded[self.hyper] = self.hyper.fold()
        return folded

    @classmethod
    def most_places(cls, config: ModelConfig, gaussians: int) -> int:
        if cls.heads is None or config.latent_grid is None:
            return gaussians
        return min(4 * gaussians, (config.latent_grid + 2) ** 2)  # nodes, of which each Gaussian needs four at most


class HyperGaussianAvatar(FlashAvatar):
    """FlashAvatar with the HyperGaussian head: the network gives each Gaussian a latent, and its HyperGaussians, given the
    latent, its offsets. With `model.latent_grid` the network is evaluated on that grid over the UV map."""

    heads = HyperHeads
    without_effect = ("upsampling",)
