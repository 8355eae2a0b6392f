"""Where a head model's parts are, also when it names no regions."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from avatar.head.assets import EYES, JOINT_NAMES, HeadAssets

EYE_JOINTS = [JOINT_NAMES.index(name) for name in EYES]
FACE = 0.12  # metres from the middle between the eyes, on the template: a mouth's opening is nearer, a neck's farther
BELOW_EYES = 0.03  # metres: farther below them than an eye socket, less far than a mouth


def region_or_all(assets: HeadAssets, name: str) -> Int[Tensor, " R"]:
    """The vertices of a region; all of them where the head model does not name it, or none in it."""
    region = assets.regions.get(name)
    return torch.arange(assets.num_vertices) if region is None or len(region) == 0 else region


def eyeballs(assets: HeadAssets) -> Int[Tensor, " R"]:
    """The vertices that turn with an eye."""
    return torch.nonzero(assets.weights[:, EYE_JOINTS].sum(dim=1) > 0.5).flatten()


def openings(assets: HeadAssets) -> Int[Tensor, " R"]:
    """The vertices on the rim of a hole in the face: the inner rim of the lips in FLAME, in others eye sockets too."""
    return torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *_rims(assets)]))


def mouth_rim(assets: HeadAssets) -> Int[np.ndarray, " R"]:
    """The vertices on the rim of the mouth: of the holes in the face below the eyes the widest; none without one."""
    points = assets.template.double().numpy()
    lower = [rim for rim in _rims(assets) if points[rim, 1].mean() < _between_eyes(assets)[1] - BELOW_EYES]
    return max(lower, key=lambda rim: np.ptp(points[rim, 0]), default=np.zeros(0, np.int64))


def _rims(assets: HeadAssets) -> list[Int[np.ndarray, " R"]]:
    """The vertices around each hole in the face."""
    triangles = assets.faces.numpy()
    edges = np.sort(np.concatenate((triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]])), axis=1)
    distinct, times = np.unique(edges, axis=0, return_counts=True)
    a, b = distinct[times == 1].T
    V = assets.num_vertices
    rim_of = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(V, V)), directed=False)[1]
    points = assets.template.double().numpy()
    middle = _between_eyes(assets)
    found = [np.flatnonzero(rim_of == rim) for rim in np.unique(rim_of[a])]
    return [rim for rim in found if np.linalg.norm(points[rim].mean(axis=0) - middle) < FACE]


def _between_eyes(assets: HeadAssets) -> Float[np.ndarray, " 3"]:
    points = assets.template.double().numpy()
    return (assets.joint_regressor[EYE_JOINTS].double().numpy() @ points).mean(axis=0)
