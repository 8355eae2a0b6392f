"""Teeth for a head model that has none: two sheets inside the mouth for Gaussians to be bound to.

A FLAME-format mesh is skin and eyeballs. Behind the opening of its mouth come two rows, the upper one fixed to the skull,
the lower one to the chin. Training gives them their look, and what one never sees stays unseen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.features import mouth_rim
from avatar.head.model import NECK

BEHIND = 0.014  # metres from the lips' foremost point in the middle back to the incisors
ARCH = 25.0  # per metre: so much times x^2 is a row set back beside the middle, 7 mm at the canines
CHIN = 0.032  # metres below the middle of the mouth
AROUND_CHIN = 0.010  # metres about that within which skin follows the lower row
SIDE = 0.33  # metres of a row that the side of the UV map stands for: 1.3 mm a texel of the default's finer raster
GRID = 13, 5  # vertices of a row, sideways and from top to bottom


class Row(NamedTuple):
    """As wide as the mouth; metres, from the middle of its opening."""

    top: float
    bottom: float
    back: float  # behind the incisors
    with_chin: bool


ROWS = (Row(0.005, -0.008, 0.0, with_chin=False), Row(0.002, -0.012, 0.002, with_chin=True))


def with_teeth(assets: HeadAssets) -> HeadAssets:
    """The head model with ROWS after its own vertices and triangles; the rest stays, the fingerprint too.

    Their UV layout lies below the map (v < 0), one beneath the other. A face without an opening for a mouth has none.
    """
    rim = mouth_rim(assets)
    if len(rim) == 0:
        return assets
    points = assets.template.numpy()
    low, high = points[rim].min(axis=0), points[rim].max(axis=0)
    middle = np.array([(low[0] + high[0]) / 2, points[rim, 1].mean(), _foremost(points, rim) - BEHIND], np.float32)
    chin = _about(points, middle + np.array([0, -CHIN, BEHIND], np.float32))
    grown, below = assets, 0.0
    for row in ROWS:
        grown = _with_row(grown, row, middle, float(high[0] - low[0]), below, rim, chin if row.with_chin else None)
        below += (row.top - row.bottom) / SIDE
    return grown


def _with_row(
    assets: HeadAssets,
    row: Row,
    middle: Float[np.ndarray, " 3"],
    width: float,
    below: float,
    rim: Int[np.ndarray, " R"],
    chin: Int[np.ndarray, " C"] | None,
) -> HeadAssets:
    """One row more, `below` the map by so many of its sides; it moves with the `chin`'s vertices or with the skull."""
    columns, rows = GRID
    height = row.top - row.bottom
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    x = width * (u - 0.5)
    offsets = np.stack((x, row.top - height * v, -row.back - ARCH * x**2), axis=-1).reshape(-1, 3)
    layout = np.stack((width / SIDE * u, -below - height / SIDE * v), axis=-1).reshape(-1, 2)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    quads = np.stack((corner, corner + columns, corner + 1, corner + 1, corner + columns, corner + columns + 1), axis=1)
    faces = torch.from_numpy(quads.reshape(-1, 3).astype(np.int64))

    K, V = len(offsets), assets.num_vertices
    weights = torch.zeros(assets.weights.shape[1])
    weights[NECK] = 1.0
    expressions = torch.zeros(assets.expression_dirs.shape[1:])
    if chin is not None:
        weights, expressions = assets.weights[chin].mean(dim=0), assets.expression_dirs[chin].mean(dim=0)

    def longer(values: Tensor, of_each: Tensor, dim: int = 0) -> Tensor:
        shape = list(values.shape)
        shape[dim] = K
        return torch.cat((values, of_each.to(values.dtype).expand(shape)), dim=dim)

    none = torch.zeros(())
    return replace(
        assets,
        template=torch.cat((assets.template, torch.from_numpy((middle + offsets).astype(np.float32)))),
        faces=torch.cat((assets.faces, faces + V)),
        shape_dirs=longer(assets.shape_dirs, assets.shape_dirs[rim].mean(dim=0)),
        expression_dirs=longer(assets.expression_dirs, expressions),
        pose_dirs=longer(assets.pose_dirs, none),
        joint_regressor=longer(assets.joint_regressor, none, dim=1),
        weights=longer(assets.weights, weights),
        eyelid_dirs=longer(assets.eyelid_dirs, none, dim=1),
        uvs=torch.cat((assets.uvs, torch.from_numpy(layout.astype(np.float32)))),
        uv_faces=torch.cat((assets.uv_faces, faces + len(assets.uvs))),
    )


def _foremost(points: Float[np.ndarray, "V 3"], rim: Int[np.ndarray, " R"]) -> float:
    """z of the lips in the middle of the mouth, metres: of what is as high as the opening or a little higher or lower."""
    low, high = points[rim].min(axis=0), points[rim].max(axis=0)
    aside = np.abs(points[:, 0] - (low[0] + high[0]) / 2)
    near = (aside < 0.1 * (high[0] - low[0])) & (points[:, 1] > low[1] - 0.008) & (points[:, 1] < high[1] + 0.008)
    return float(points[near, 2].max(initial=high[2]))


def _about(points: Float[np.ndarray, "V 3"], place: Float[np.ndarray, " 3"]) -> Int[np.ndarray, " C"]:
    """The vertices within `AROUND_CHIN` of the one that is nearest to a place."""
    tree = KDTree(points)
    nearest = points[tree.query(place)[1]]
    return np.array(sorted(tree.query_ball_point(nearest, AROUND_CHIN)))
