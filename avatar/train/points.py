"""What training does to points on the mesh between its steps: they walk, and their set grows."""

from __future__ import annotations

import math

import torch
from jaxtyping import Int
from torch import Tensor

from avatar.config import TrainerConfig
from avatar.gaussians.growth import alive_after
from avatar.gaussians.mesh_points import MeshPoints
from avatar.model import Avatar

TRANSPARENT = 0.005  # opacity below which a point is removed when the set grows, as 3D Gaussian Splatting prunes


def move_points(avatar: Avatar, optimizer: torch.optim.Adam, steps: int, config: TrainerConfig) -> None:
    """After `steps` steps: bring places that have left their triangle into the next one, and let the set grow when it is
    time. A function of the parameters, the step and the seed, so that a resumed run goes on as an uninterrupted one."""
    points = avatar.mesh_points
    if points is None:
        return
    if points.place.requires_grad:
        points.walk([state["exp_avg"]] if (state := optimizer.state[points.place]) else [])
    if avatar.count is not None and alive_after(steps, config.iterations, len(avatar)) > int(avatar.count):
        grow(avatar, points, optimizer, alive_after(steps, config.iterations, len(avatar)), config.seed + steps)


@torch.no_grad()
def grow(avatar: Avatar, points: MeshPoints, optimizer: torch.optim.Adam, size: int, seed: int) -> None:
    """Let `size` points be alive: new ones, and those in the place of transparent ones, begin beside visible ones.

    A child lies where its parent's splat reaches, on the mesh, and is like it in all else. Both are smaller than the
    parent was, so that the splats cover as much as before: the root of a half for a doubling.
    """
    assert avatar.count is not None
    alive = int(avatar.count)
    visible = torch.sigmoid(avatar.opacity_logits[:alive]) >= TRANSPARENT
    parents_there, transparent = visible.nonzero()[:, 0].cpu(), (~visible).nonzero()[:, 0].cpu()
    avatar.count.fill_(size)
    born = torch.cat((transparent, torch.arange(alive, size)))
    if len(parents_there) == 0:  # nothing to be like
        avatar.encode_points()
        return
    generator = torch.Generator().manual_seed(seed)
    parents = drawn(parents_there, len(born), generator).to(points.face.device)
    born = born.to(points.face.device)
    distinct = parents.unique()
    avatar.log_scales[distinct] -= math.log(2.0) / 2
    reach = avatar.log_scales[parents].mean(dim=1, keepdim=True).exp()
    aside = torch.randn(len(born), 2, generator=generator).to(reach) * reach
    points.face[born] = points.face[parents]
    points.place[born] = points.place[parents]
    points.place[born, :2] += aside
    points.walk()
    for parameter in (avatar.log_scales, avatar.quats, avatar.opacity_logits, avatar.sh_dc, avatar.sh_rest):
        parameter[born] = parameter[parents]
        for key in ("exp_avg", "exp_avg_sq"):
            if key in optimizer.state[parameter]:
                optimizer.state[parameter][key][born] = optimizer.state[parameter][key][parents]
    avatar.encode_points()


def drawn(from_: Int[Tensor, " P"], count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """So many of these in random order, none a second time before each has come once."""
    rounds = [from_[torch.randperm(len(from_), generator=generator)] for _ in range(-(-count // len(from_)))]
    return torch.cat([*rounds, from_[:0]])[:count]
