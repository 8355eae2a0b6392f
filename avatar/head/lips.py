"""How far a head's lips are apart, for any topology whose upper and lower lip are not one surface."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from avatar.head.assets import HeadAssets

# In mouth widths. In the middle half of the mouth the way along the mesh from one lip to the other, round a corner of the
# mouth, is longer than FAR; round the edge of one lip it is shorter.
FAR = 0.5
TOUCHING = 0.1  # at rest, lips of a closed mouth are nearer to each other than this
REACH = 1.5  # the mesh is looked at so far about the mouth


def lip_pairs(assets: HeadAssets) -> Int[Tensor, "P 2"]:
    """Pairs of vertices, one on each lip, that touch while the mouth is closed: each the other's nearest among the lips'
    vertices that are far away along the mesh.

    None (P = 0) where the head model has no region `lips`, its mouth is open in the template, or it has no mouth opening.
    """
    lips = assets.regions.get("lips", torch.zeros(0, dtype=torch.int64)).numpy()
    if len(lips) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    points = assets.template.double().numpy()
    width = float(np.ptp(points[lips], axis=0).max())
    along = _distances_along_mesh(points, assets.faces.numpy(), lips, FAR * width, REACH * width)
    across = np.linalg.norm(points[lips][:, None] - points[lips], axis=2)
    across[np.isfinite(along)] = np.inf
    nearest = across.argmin(axis=1)
    own = np.arange(len(lips))
    chosen = (nearest[nearest] == own) & (across[own, nearest] < TOUCHING * width) & (own < nearest)
    return torch.from_numpy(np.stack((lips[own[chosen]], lips[nearest[chosen]]), axis=1))


def lip_gap(vertices: Float[Tensor, "N V 3"], pairs: Int[Tensor, "P 2"]) -> Float[Tensor, " N"]:
    """The mean distance of the pairs of `lip_pairs`, in the vertices' unit. There has to be a pair."""
    return (vertices[:, pairs[:, 0]] - vertices[:, pairs[:, 1]]).norm(dim=-1).mean(dim=1)


def _distances_along_mesh(
    points: np.ndarray, faces: np.ndarray, sources: np.ndarray, limit: float, reach: float
) -> np.ndarray:
    """Between all pairs of `sources` along edges, infinite beyond `limit`; only edges within `reach` of them are walked."""
    low, high = points[sources].min(axis=0) - reach, points[sources].max(axis=0) + reach
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    row_of = np.full(len(points), -1)
    row_of[near] = np.arange(len(near))
    edges = np.unique(np.sort(np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])), axis=1), axis=0)
    a, b = edges[(row_of[edges] >= 0).all(axis=1)].T
    lengths = np.linalg.norm(points[a] - points[b], axis=1) + 1e-9  # an edge of no length is not no edge
    graph = coo_array((lengths, (row_of[a], row_of[b])), shape=(len(near), len(near))).tocsr()
    return dijkstra(graph, directed=False, indices=row_of[sources], limit=limit)[:, row_of[sources]]
