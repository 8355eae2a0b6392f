"""MonoGaussianAvatar in FlashAvatar's place: the network gives offsets to a set of points that grows.

MonoGaussianAvatar (Chen et al., SIGGRAPH 2024) begins with few points, and inserts and removes some while it is trained, as
HyperGaussians (CVPR 2026) describes it. Here a set has its final size in memory from the start, of which the first ones are
alive: so a checkpoint has the shapes that the configuration says, and what is alive is a function of the step.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.baselines.mesh_points import MeshPoints
from avatar.config import ModelConfig, TrainerConfig
from avatar.gaussians.encoding import positional_encoding
from avatar.gaussians.mesh_embedding import knn_scales
from avatar.gaussians.uv import UVTexels
from avatar.head.assets import HeadAssets
from avatar.model import FlashAvatar
from avatar.types import HeadParams

DOUBLINGS, EVERY = 4, 0.1  # from 1/16 of the points; each doubling after so large a share of the steps
# Of every 4 x 4 texels, which comes when: each prefix of 1, 2, 4, 8 and 16 is spread evenly (an ordered-dither matrix).
ORDER = ((0, 8, 2, 10), (12, 4, 14, 6), (3, 11, 1, 9), (15, 7, 13, 5))
TRANSPARENT = 0.005  # opacity below which a point is removed when the set grows, as 3D Gaussian Splatting prunes


def active_count(steps: int, iterations: int, capacity: int) -> int:
    """How many points are alive after so many of a training's steps; at least 1."""
    doublings = min(int(steps / (EVERY * iterations) + 1e-9), DOUBLINGS)
    return max(1, capacity >> (DOUBLINGS - doublings))


def evenly_ordered(texels: UVTexels) -> UVTexels:
    """The texels in an order of which every beginning is spread over the map."""
    rank = torch.tensor(ORDER)[texels.row % 4, texels.column % 4]
    order: Int[Tensor, " N"] = torch.argsort(rank, stable=True)
    return UVTexels(*(values[order] for values in texels))


def random_choice(from_: Int[Tensor, " P"], count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """So many of these in random order, none a second time before each has come once."""
    rounds = [from_[torch.randperm(len(from_), generator=generator)] for _ in range(-(-count // len(from_)))]
    return torch.cat([*rounds, from_[:0]])[:count]


class MonoGaussianAvatar(FlashAvatar):
    is_fused = False
    is_replayable = False  # the set of points grows
    unknown_to_browsers = "points that have left their texel"
    without_effect = *FlashAvatar.without_effect, "skull_binding"
    count: Tensor  # of the points that are alive, which are the first ones

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__(assets, identity, config)
        place = self.embedding.texels.face, self.embedding.barycentric
        self.mesh_points.bind(self.mesh.faces, self.mesh.neutral_vertices(), *place)
        first = self.active(self.neutral_points())
        with torch.no_grad():
            self.active(self.log_scales).copy_(torch.log(knn_scales(first))[:, None])
        self.code = self.active(self.code)

    ordered = staticmethod(evenly_ordered)

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        super().make_parameters(replace(config, skull_binding=False), num_expressions, N)
        self.mesh_points = MeshPoints(N, learned=False)
        self.register_buffer("count", torch.tensor(active_count(0, 1, N)))

    def active(self, values: Float[Tensor, "N ..."]) -> Float[Tensor, "alive ..."]:
        """Those of the points that are alive."""
        return values[: int(self.count)]

    def base(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        quats, log_scales, opacity_logits, sh = map(self.active, super().base())
        return quats, log_scales, opacity_logits, sh

    def points(self, vertices: Float[Tensor, "V 3"], params: HeadParams) -> Float[Tensor, "alive 3"]:
        return self.active(self.mesh_points.points(vertices))

    def encode_points(self) -> None:
        """Give the network the places that the points have now; before any growth to the bit what it begins with."""
        vertices = self.mesh.neutral_vertices().to(self.device)
        points = self.embedding if int(self.count) == active_count(0, 1, len(self)) else self.mesh_points
        self.code = positional_encoding(self.active(points.points(vertices)))

    def after_load(self) -> None:
        super().after_load()
        if not 1 <= int(self.count) <= len(self):
            raise ValueError(f"has {int(self.count)} points alive of {len(self)}")
        self.encode_points()

    def after_step(self, optimizer: torch.optim.Adam, steps: int, config: TrainerConfig) -> None:
        """Let the set grow when it is time."""
        size = active_count(steps, config.iterations, len(self))
        if size > int(self.count):
            self.grow(optimizer, size, config.seed + steps)

    @torch.no_grad()
    def grow(self, optimizer: torch.optim.Adam, size: int, seed: int) -> None:
        """Let `size` points be alive: new ones, and those in the place of transparent ones, begin beside visible ones.

        A child lies where its parent's splat reaches, on the mesh, and is like it in all else. Both are smaller than the
        parent was, so that the splats cover as much as before: the root of a half for a doubling.
        """
        points = self.mesh_points
        alive = int(self.count)
        visible = torch.sigmoid(self.opacity_logits[:alive]) >= TRANSPARENT
        parents_there, transparent = visible.nonzero()[:, 0].cpu(), (~visible).nonzero()[:, 0].cpu()
        self.count.fill_(size)
        born = torch.cat((transparent, torch.arange(alive, size)))
        if len(parents_there) == 0:  # nothing to be like
            self.encode_points()
            return
        generator = torch.Generator().manual_seed(seed)
        parents = random_choice(parents_there, len(born), generator).to(points.face.device)
        born = born.to(points.face.device)
        distinct = parents.unique()
        self.log_scales[distinct] -= math.log(2.0) / 2
        reach = self.log_scales[parents].mean(dim=1, keepdim=True).exp()
        aside = torch.randn(len(born), 2, generator=generator).to(reach) * reach
        points.face[born] = points.face[parents]
        points.place[born] = points.place[parents]
        points.place[born, :2] += aside
        points.walk()
        for parameter in (self.log_scales, self.quats, self.opacity_logits, self.sh_dc, self.sh_rest):
            parameter[born] = parameter[parents]
            for key in ("exp_avg", "exp_avg_sq"):
                if key in optimizer.state[parameter]:
                    optimizer.state[parameter][key][born] = optimizer.state[parameter][key][parents]
        self.encode_points()
