"""Gaussians bound to the mesh: one per covered texel of the UV map, at a fixed place of its triangle."""

from __future__ import annotations

from copy import copy

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import embedding_bag

from avatar.gaussians.hyper_cpu import Touching, touching_lists
from avatar.gaussians.uv import UVTexels
from avatar.head.assets import HeadAssets


class Embedding:
    """Maps the vertices of a posed mesh [V, 3] to one point per texel [N, 3]."""

    def __init__(self, assets: HeadAssets, texels: UVTexels) -> None:
        self.texels = texels
        self.corners: Int[Tensor, "N 3"] = assets.faces[texels.face]
        self.barycentric: Float[Tensor, "N 3"] = texels.barycentric
        self._flat_corners = self.corners.reshape(-1)
        self._touching: Touching | None = None
        self._is_folded = False

    def __len__(self) -> int:
        return len(self.corners)

    def points(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "N 3"]:
        if self._is_folded:
            return embedding_bag(self.corners, vertices, mode="sum", per_sample_weights=self.barycentric)
        corners = vertices.index_select(0, self._flat_corners).reshape(-1, 3, 3)
        return (corners * self.barycentric.to(vertices.dtype)[:, :, None]).sum(dim=1)

    def fold(self) -> Embedding:
        """The same to rounding, in one operator, for inference."""
        folded = copy(self)
        folded._is_folded = True
        return folded

    def touching(self, num_vertices: int) -> Touching:
        """The Gaussians that hang on each vertex; made when it is first asked for."""
        if self._touching is None:
            self._touching = touching_lists(self.corners, self.barycentric, num_vertices)
        return self._touching

    def move(self, device: torch.device) -> None:
        """Bring it to where the vertices are to be. The texels stay: they are for people."""
        if self.corners.device != device:
            self.corners, self.barycentric = self.corners.to(device), self.barycentric.to(device)
            self._flat_corners = self.corners.reshape(-1)
            if self._touching is not None:
                self._touching = Touching(*(part.to(device) for part in self._touching))


def knn_scales(points: Float[Tensor, "N 3"], neighbours: int = 3) -> Float[Tensor, " N"]:
    """Root mean squared distance of each point to its nearest neighbours, in metres; never below 1e-4 m.

    Source: 3D Gaussian Splatting's initial scales, as FlashAvatar uses them. The floor keeps coincident points finite.
    """
    cloud = points.detach().cpu().numpy().astype(np.float64)
    k = min(neighbours, len(cloud) - 1)
    if k < 1:
        return torch.full((len(cloud),), 1e-2, dtype=points.dtype)
    distances = KDTree(cloud).query(cloud, k=k + 1)[0][:, 1:]
    rms = np.sqrt(np.mean(np.square(distances), axis=1))
    return torch.from_numpy(np.maximum(rms, 1e-4)).to(points.dtype)
