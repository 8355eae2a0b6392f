"""Avatars whose Gaussians are bound to the UV map of a head model: one Gaussian at each covered texel, with a colour."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.config import OPACITY_RATE, Initialization, ModelConfig, TrainerConfig
from avatar.data.frame import Frame
from avatar.gaussians.base_model import Avatar, Groups
from avatar.gaussians.initial_colours import mean_colours
from avatar.gaussians.mesh_embedding import Embedding, knn_scales
from avatar.gaussians.uv import UVTexels, bound_texels
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.head.teeth import with_teeth
from avatar.splat.sh import C0

SH_DEGREE = 3  # of the view-dependent colour


class UVAvatar(Avatar):
    """Gaussians that are bound to the UV map of a head model; with `config.teeth`, `mesh` has teeth behind the lips."""

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__(assets, identity, config)
        mesh = with_teeth(assets) if config.teeth else assets
        if mesh is not assets:
            self.mesh = HeadModel(mesh, identity)
        self.embedding = Embedding(mesh, self.ordered(bound_texels(assets, mesh, config.uv_size, config.uv_detail)))
        with torch.no_grad():
            self.log_scales.copy_(torch.log(knn_scales(self.neutral_points()))[:, None])

    @classmethod
    def count_gaussians(cls, config: ModelConfig, assets: HeadAssets) -> int:
        mesh = with_teeth(assets) if config.teeth else assets
        return len(bound_texels(assets, mesh, config.uv_size, config.uv_detail).face)

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        super().make_parameters(config, num_expressions, N)
        self.sh_dc = nn.Parameter(torch.zeros(N, 1, 3))
        self.sh_rest = nn.Parameter(torch.zeros(N, (SH_DEGREE + 1) ** 2 - 1, 3))

    @staticmethod
    def ordered(texels: UVTexels) -> UVTexels:
        """The order of the Gaussians."""
        return texels

    @torch.no_grad()
    def initialize_from(self, frames: Iterable[Frame], start: Initialization) -> None:
        """Set the base colour of each Gaussian to the mean that the frames show at its place; those that no frame shows
        keep theirs."""
        if start == "grey":
            return
        mean, seen = mean_colours(self.mesh, self.embedding, frames)
        self.sh_dc[seen, 0] = (mean[seen] - 0.5) / C0

    def parameter_groups(self, trainer: TrainerConfig) -> Groups:
        rates = trainer.learning_rates
        return {
            "colour": ([self.sh_dc], rates.sh_dc),
            "view-dependent colour": ([self.sh_rest], rates.sh_rest),
            "logits": ([self.opacity_logits], OPACITY_RATE),
            "scale": ([self.log_scales], rates.scale),
            "rotation": ([self.quats], rates.rotation),
        }

    def frozen(self) -> Self:
        copy = super().frozen()
        base = copy.base()
        copy.base = lambda: base
        del copy.sh_dc, copy.sh_rest  # which `base` has in one
        return copy

    def base(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Quaternions, log-scales, logits of the opacities and colours of the Gaussians that are drawn."""
        return self.quats, self.log_scales, self.opacity_logits, torch.cat((self.sh_dc, self.sh_rest), dim=1)

    def neutral_points(self) -> Float[Tensor, "N 3"]:
        """Where the Gaussians are bound to the neutral mesh, metres; on the CPU, before the avatar is moved."""
        return self.embedding.points(self.mesh.neutral_vertices())
