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
from avatar.types import HeadParams

STEPS = 500
HEADS, POINTS = 8, 512  # in each step, and points of each head
NETWORK_RATE, GAUSSIAN_RATE = 3e-3, 1e-2  # Adam's at the start; they decay along half a cosine
BEYOND = 0.25  # of the distance between two frames: how far heads lie past them
LENGTH = 0.01  # metres: an error that counts as much as an opacity of 0 in the place of 1
SPREAD = 1.0  # standard deviations of the coefficients over frames, as noise

Moved = Callable[[Sequence[HeadParams], Int[Tensor, "H P"]], tuple[Float[Tensor, "HP 3"], Float[Tensor, " HP"] | None]]


class MeshMotion:
    """How far points move with the mesh: as far as the nearest point of `mesh`, metres."""

    def __init__(self, head: HeadModel, mesh: Embedding, points: Float[Tensor, "R 3"]) -> None:
        self.head = head
        rest = head.neutral_vertices()
        _, nearest = KDTree(mesh.points(rest).numpy()).query(points.numpy())
        self.rest, self.corners, self.weights = rest, mesh.corners[nearest], mesh.barycentric[nearest]

    def __call__(self, heads: Sequence[HeadParams], rows: Int[Tensor, "H P"]) -> Float[Tensor, "H P 3"]:
        """`rows` are the points of each head."""
        moves = torch.stack([self.head.vertices(params) - self.rest for params in heads])
        of_corners = moves[torch.arange(len(heads))[:, None, None], self.corners[rows]]
        return (of_corners * self.weights[rows][..., None]).sum(dim=2)


def random_head(params: Sequence[HeadParams]) -> HeadParams:
    """Between two of the frames or a little beyond, for jaw, eyes, lids and expression each on its own, with noise."""
    conditions = torch.stack([p.condition() for p in params])
    drawn = {}
    for name in ("expression", "jaw", "eyes", "eyelids"):
        first, second = (getattr(params[i], name) for i in torch.randint(len(params), (2,)).tolist())
        drawn[name] = torch.lerp(first, second, float(torch.empty(()).uniform_(-BEYOND, 1.0 + BEYOND)))
    head = replace(params[0], **drawn)
    spread = conditions.std(dim=0, correction=0)
    return head.with_condition(head.condition() + SPREAD * spread * torch.randn_like(spread))


def fit_motion(
    moved: Moved,
    target: MeshMotion,
    params: Sequence[HeadParams],
    points: int,
    network: Sequence[Tensor],
    gaussians: Sequence[Tensor],
) -> None:
    """Fit `moved`, a function of the tensors `network` and `gaussians`, to the mesh at heads like those of `params`.

    `moved` gives displacements in metres of chosen ones of so many points, and factors of their opacity, which are to
    stay 1.
    """
    rates = [(network, NETWORK_RATE), (gaussians, GAUSSIAN_RATE)]
    optimizer = torch.optim.Adam([{"params": values, "lr": rate} for values, rate in rates if values])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        heads = [random_head(params) for _ in range(HEADS)]
        rows = torch.randint(points, (HEADS, POINTS))
        with torch.enable_grad():
            moves, density = moved(heads, rows)
            loss = ((moves - target(heads, rows).flatten(0, 1)) / LENGTH).square().mean()
            if density is not None:
                loss = loss + (density - 1.0).square().mean()
            optimizer.zero_grad()
            loss.backward()
        optimizer.step()
        schedule.step()
