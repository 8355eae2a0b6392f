"""The avatar: one frame's head parameters in, Gaussians out. The whole method on one page."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.config import ModelConfig
from avatar.gaussians.compose import compose_raw
from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.embedding import Embedding, knn_scales
from avatar.gaussians.encoding import encoded_size, positional_encoding
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.latent_grid import LatentGrid, latent_grid
from avatar.gaussians.uv import uv_texels
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.types import Gaussians, HeadParams

CONDITION_EXTRAS = 20  # jaw 6, eyes 12, eyelids 2, after the expression coefficients


class Avatar(nn.Module):
    """One person's avatar, bound to the UV map of a head model.

    `name = "hypergaussians"`: the network gives each Gaussian a latent, its HyperGaussians turn that into offsets. With
    `latent_grid` the network is evaluated on that grid over the UV map and its latents are interpolated to the Gaussians.
    `name = "flashavatar"`: the network gives the offsets itself; they are not smooth over the map, so no grid is used.
    """

    code: Tensor

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.head = HeadModel(assets, identity)
        self.embedding = Embedding(assets, uv_texels(assets, config.uv_size))
        N = len(self.embedding)
        neutral = self.embedding.points(self.head.neutral_vertices())
        is_hyper = config.name == "hypergaussians"
        self.grid: LatentGrid | None = None
        if is_hyper and config.latent_grid is not None:
            self.grid = latent_grid(assets, self.embedding.texels, config.uv_size, neutral, config.latent_grid)
        places = neutral if self.grid is None else self.grid.places
        self.register_buffer("code", positional_encoding(places, config.frequencies), persistent=False)

        self.deformation = DeformationMLP(
            code_size=encoded_size(config.frequencies),
            condition_size=assets.num_expressions + CONDITION_EXTRAS,
            out_size=config.latent_dim if is_hyper else 10,
            width=config.mlp_width,
            layers=config.mlp_layers,
        )
        self.hyper = HyperHeads(N, config.latent_dim) if is_hyper else None

        initial_scale = torch.log(knn_scales(neutral))
        self.log_scales = nn.Parameter(initial_scale[:, None].repeat(1, 3))
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(N, 1))
        initial_opacity = torch.logit(torch.tensor(config.initial_opacity))
        self.opacity_logits = nn.Parameter(initial_opacity.repeat(N))
        coefficients = (config.sh_degree + 1) ** 2
        self.sh_dc = nn.Parameter(torch.zeros(N, 1, 3))
        self.sh_rest = nn.Parameter(torch.zeros(N, coefficients - 1, 3))

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.embedding)

    def forward(self, params: HeadParams, vertices: Float[Tensor, "V 3"] | None = None) -> Gaussians:
        """The Gaussians of one frame, world space. `vertices`: the head posed by `params` already, metres."""
        points = self.embedding.points(self.head.vertices(params) if vertices is None else vertices)
        raw = self.deformation(self.code, self.condition(params))
        if self.grid is not None:
            raw = self.grid.interpolate(raw)
        if self.hyper is not None:
            raw = self.hyper(raw)
        sh = torch.cat((self.sh_dc, self.sh_rest), dim=1)
        return compose_raw(points, self.quats, self.log_scales, self.opacity_logits, sh, raw)

    def condition(self, params: HeadParams) -> Float[Tensor, " D"]:
        """The network's input, with expression coefficients that the frame does not carry as zeros."""
        condition = params.condition()
        missing = self.deformation.condition_size - len(condition)
        if missing == 0:
            return condition
        E = len(params.expression)
        return torch.cat((condition[:E], condition.new_zeros(missing), condition[E:]))
