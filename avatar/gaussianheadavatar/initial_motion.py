"""Motion before training: the networks learn to move points as the mesh moves, for heads of which there is no picture.

Some dozens of training times do not tell a hundred expression coefficients apart. The head model shows as many heads as
are asked for. This takes the place of the landmark loss in the first stage of Gaussian Head Avatar (CVPR 2024).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from avatar.gaussians.mesh_embedding import Embedding
from avatar.head.model import HeadModel
from avatar.types import IDENTITY_6D, HeadParams

STEPS, POINTS = 500, 4096  # points of each step, each with a head at random
HEADS = 1024
NETWORK_RATE, GAUSSIAN_RATE = 3e-3, 1e-2  # Adam's at the start; they decay along half a cosine
BEYOND = 0.25  # of the distance between two frames: how far heads lie past them
SPREAD = 1.0  # standard deviations of the coefficients over frames, as noise
LENGTH = 0.01  # metres: an error that counts as much as an opacity of 0 in the place of 1

Moved = Callable[[Float[Tensor, "M C"], Int[Tensor, " M"]], tuple[Float[Tensor, "M 3"], Float[Tensor, " M"] | None]]


class MeshMotion:
    """How far points move with the mesh: as far as the nearest point of `mesh`, metres."""

    def __init__(
        self, head: HeadModel, mesh: Embedding, points: Float[Tensor, "R 3"], heads: Sequence[HeadParams]
    ) -> None:
        rest = head.neutral_vertices()
        _, nearest = KDTree(mesh.points(rest).numpy()).query(points.numpy())
        self.corners, self.weights = mesh.corners[nearest], mesh.barycentric[nearest]
        self.moves = torch.stack([head.vertices(params) - rest for params in heads])

    def __call__(self, heads: Int[Tensor, " M"], rows: Int[Tensor, " M"]) -> Float[Tensor, "M 3"]:
        """Of points `rows` with one of the heads each."""
        of_corners = self.moves[heads[:, None], self.corners[rows]]
        return (of_corners * self.weights[rows][..., None]).sum(dim=1)


def random_heads(params: Sequence[HeadParams]) -> list[HeadParams]:
    """Heads between two frames or a little beyond; jaw, eyes, lids and expression each on its own, with noise.

    The neck is at rest: the pose's network moves what follows it. An expression coefficient that the frames leave as it is
    gets as much noise as the others on average.
    """
    spread = torch.stack([p.condition() for p in params]).std(dim=0, correction=0)
    of_expression = spread[: len(params[0].expression)]
    of_expression.clamp_(min=float(of_expression.square().mean().sqrt()))
    heads, rest = [], replace(params[0], neck=params[0].neck.new_tensor(IDENTITY_6D))
    for _ in range(HEADS):
        drawn = {}
        for name in ("expression", "jaw", "eyes", "eyelids"):
            first, second = (getattr(params[i], name) for i in torch.randint(len(params), (2,)).tolist())
            drawn[name] = torch.lerp(first, second, float(torch.empty(()).uniform_(-BEYOND, 1.0 + BEYOND)))
        condition = replace(rest, **drawn).condition()
        heads.append(rest.with_condition(condition + SPREAD * spread * torch.randn_like(spread)))
    return heads


def fit_motion(
    moved: Moved,
    target: MeshMotion,
    conditions: Float[Tensor, "H C"],
    network: Sequence[Tensor],
    gaussians: Sequence[Tensor],
) -> None:
    """Fit `moved`, a function of the tensors `network` and `gaussians`, to the mesh.

    conditions  the network's inputs for the heads of `target`
    moved       gives displacements in metres of some of the points, and factors of their opacity, which are to stay 1
    """
    rates = [(network, NETWORK_RATE), (gaussians, GAUSSIAN_RATE)]
    optimizer = torch.optim.Adam([{"params": values, "lr": rate} for values, rate in rates if values])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        heads = torch.randint(len(conditions), (POINTS,))
        rows = torch.randint(len(target.corners), (POINTS,))
        with torch.enable_grad():
            moves, density = moved(conditions[heads], rows)
            loss = ((moves - target(heads, rows)) / LENGTH).square().mean()
            if density is not None:
                loss = loss + (density - 1.0).square().mean()
            optimizer.zero_grad()
            loss.backward()
        optimizer.step()
        schedule.step()
