"""The surface between grid points of negative and of other values, as triangles.

    s = v_a / (v_a - v_b)      where on the edge from grid point a to b the surface is, with v_a and v_b of unlike sign

Source: Doi and Koide, An efficient method of triangulating equi-valued surfaces by using tetrahedral cells (1991).
"""

from __future__ import annotations

from itertools import permutations
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.tensors import take_rows


class Grid(NamedTuple):
    """Points at the corners of equal cubes; a volume of values has their shape, a list of values the order of `points`."""

    low: Float[Tensor, " 3"]  # the first point, metres
    cell: float  # a cube's side, metres
    shape: tuple[int, int, int]  # points along x, y and z

    def points(self) -> Float[Tensor, "P 3"]:
        axes = [self.low[i] + self.cell * torch.arange(count) for i, count in enumerate(self.shape)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)

    def tetrahedra(self) -> Int[Tensor, "T 4"]:
        """Six of each cube, around one of its diagonals: neighbours share whole faces."""
        _, y, z = self.shape
        first = torch.arange(self.shape[0] * y * z).reshape(self.shape)[:-1, :-1, :-1].flatten()
        tets = [torch.stack((first, first + a, first + a + b, first + a + b + c), dim=1)
                for a, b, c in permutations((y * z, z, 1))]  # fmt: skip
        return torch.cat(tets)


class Surface(NamedTuple):
    """Triangles whose corners lie on edges of the grid."""

    edges: Int[Tensor, "E 2"]  # grid points
    shares: Float[Tensor, " E"]  # of the way from the first to the second
    faces: Int[Tensor, "F 3"]  # of edges, in no particular direction

    def of(self, values: Float[Tensor, "P D"]) -> Float[Tensor, "E D"]:
        """What grid points have, at the triangles' corners."""
        first, second = take_rows(values, self.edges).unbind(1)
        return torch.lerp(first, second, self.shares[:, None])


def marching_tetrahedra(values: Float[Tensor, " P"], tets: Int[Tensor, "T 4"]) -> Surface:
    """The surface, differentiable in `values` as long as no sign changes."""
    inside = values.detach() < 0
    count = inside[tets].sum(dim=1)
    # Those inside first.
    ordered = tets.gather(1, inside[tets].int().argsort(dim=1, descending=True))
    triangles = []
    for n, edges in ((1, ((0, 1), (0, 2), (0, 3))), (3, ((3, 0), (3, 1), (3, 2)))):
        triangles.append(_triangles(ordered[count == n], edges))
    two = ordered[count == 2]
    triangles += [_triangles(two, edges) for edges in (((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2)))]
    low, high = torch.cat(triangles).sort(dim=-1).values.unbind(-1)
    keys, faces = (low * len(values) + high).unique(return_inverse=True)
    edges = torch.stack((keys // len(values), keys % len(values)), dim=1)
    first, second = take_rows(values, edges).unbind(1)
    return Surface(edges, first / (first - second), faces)


def _triangles(tets: Int[Tensor, "T 4"], edges: tuple[tuple[int, int], ...]) -> Int[Tensor, "T 3 2"]:
    return torch.stack([tets[:, list(edge)] for edge in edges], dim=1)
