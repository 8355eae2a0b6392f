"""Latents on a coarse grid over the UV map: the network is evaluated at its nodes and interpolated to the Gaussians.

A HyperGaussian turns its latent into offsets by a map of its own, so what is local lies in the heads, and the latent may
vary slowly over the surface. The nodes are the centres of the cells of a `cells` x `cells` raster over the UV map. A node
belongs to one chart (connected part) of the UV layout: neighbours on the map that are strangers on the head, such as an
eyeball beside a cheek, are never mixed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from avatar.gaussians.hyper_cpu import Interpolation
from avatar.gaussians.uv import UVTexels
from avatar.head.assets import HeadAssets


class LatentGrid(NamedTuple):
    """M nodes and where each of N Gaussians lies between them."""

    interpolate: Interpolation  # values of the nodes [M, n] -> at the Gaussians [N, n]; bilinear, weights add up to 1
    places: Float[Tensor, "M 3"]  # of the nodes on the neutral mesh, metres


def latent_grid(assets: HeadAssets, texels: UVTexels, points: Float[Tensor, "N 3"], cells: int) -> LatentGrid:
    """The grid of `cells` x `cells` cells over the UV map that `texels` were taken from.

    points   of the texels on the neutral mesh, metres; a node lies at their mean, weighted as they are interpolated from it
    Only nodes that some Gaussian takes part of are made.
    """
    chart = torch.from_numpy(uv_charts(assets.uv_faces.numpy(), len(assets.uvs)))[texels.face]
    sides = []
    for texel in (texels.row, texels.column):
        # In units of cells, with the first cell's centre at 0; outside the outermost centres the nearest one counts.
        position = ((texel.double() + 0.5) * cells / texels.side - 0.5).clamp(0, cells - 1)
        low = position.floor()
        sides.append((low.long(), position - low))
    (row, down), (column, right) = sides
    keys, weights = [], []
    for i, vertical in ((0, 1 - down), (1, down)):
        for j, horizontal in ((0, 1 - right), (1, right)):
            keys.append((chart * cells + row + i) * cells + column + j)
            weights.append(vertical * horizontal)
    key, weight = torch.stack(keys, dim=1), torch.stack(weights, dim=1)
    # A corner of no weight, which may lie beyond the map, must not bring a node into being: it stands for the Gaussian's
    # heaviest one.
    heaviest = key.gather(1, weight.argmax(dim=1, keepdim=True))
    key = torch.where(weight > 0, key, heaviest)
    used, nodes = torch.unique(key, return_inverse=True)
    flat, share = nodes.reshape(-1), weight.reshape(-1)
    total = torch.zeros(len(used), dtype=torch.float64).index_add_(0, flat, share)
    pulled = (points.double()[:, None, :] * weight[..., None]).reshape(-1, 3)
    places = torch.zeros(len(used), 3, dtype=torch.float64).index_add_(0, flat, pulled) / total[:, None]
    return LatentGrid(Interpolation(nodes, weight.float(), len(used)), places.to(points.dtype))


def uv_charts(uv_faces: Int[np.ndarray, "F 3"], num_uvs: int) -> Int[np.ndarray, " F"]:
    """For each triangle of the UV layout the number of the connected part that it belongs to."""
    ends = np.concatenate((uv_faces[:, [0, 1]], uv_faces[:, [1, 2]]))
    edges = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(num_uvs, num_uvs))
    _, part_of_uv = connected_components(edges, directed=False)
    return part_of_uv[uv_faces[:, 0]].astype(np.int64)
