"""SplattingAvatar in FlashAvatar's place: Gaussians embedded on the mesh at learned places, which alone moves them.

Source: Shao et al., SplattingAvatar (CVPR 2024), as its abstract and HyperGaussians (CVPR 2026) describe it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from avatar.baselines.mesh_points import MeshPoints
from avatar.config import HYPER_RATE, ModelConfig, TrainerConfig
from avatar.gaussians.apply_offsets import quaternion_product
from avatar.gaussians.base_model import Groups
from avatar.gaussians.uv_base_model import UVAvatar
from avatar.head.assets import HeadAssets
from avatar.types import Gaussians, HeadParams


class SplattingAvatar(UVAvatar):
    unknown_to_browsers = "points that have left their texel"
    without_effect = (
        *("upsampling", "latent_dim", "latent_grid", "mlp_width", "mlp_layers"),
        *("skull_binding", "head_rotation"),
    )
    trained_without = ("condition_noise",)

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__(assets, identity, config)
        place = self.embedding.texels.face, self.embedding.barycentric
        self.mesh_points.bind(self.mesh.faces, self.mesh.neutral_vertices(), *place)

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        super().make_parameters(config, num_expressions, N)
        self.mesh_points = MeshPoints(N, learned=True)

    def forward(self, params: HeadParams, vertices=None, rotation=None) -> Gaussians:
        vertices = self.vertices(params) if vertices is None else vertices
        quats, log_scales, opacity_logits, sh = self.base()
        turned = quaternion_product(self.mesh_points.turns(vertices), normalize(quats, dim=-1))
        means, opacities = self.mesh_points.points(vertices), torch.sigmoid(opacity_logits)
        return Gaussians(means, normalize(turned, dim=-1), torch.exp(log_scales), opacities, sh)

    def parameter_groups(self, trainer: TrainerConfig) -> Groups:
        groups = super().parameter_groups(trainer)
        groups["places"] = [self.mesh_points.place], HYPER_RATE
        return groups

    def after_step(self, optimizer: torch.optim.Adam, steps: int, config: TrainerConfig) -> None:
        """Bring places that have left their triangle into the next one."""
        state = optimizer.state[self.mesh_points.place]
        self.mesh_points.walk([state["exp_avg"]] if state else [])
