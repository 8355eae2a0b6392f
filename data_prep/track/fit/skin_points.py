"""Which points of the head the photometric fit compares, and in which frames they are seen."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE
from avatar.head.rasterize import rasterize_mesh

# With 1,300 to 2,000 points the face's error on two demo people is 0.44 or 0.51 % of the irises' distance, by how many
# exactly; from here on it does not fall.
COUNT = 2500
_DEPTH_TOLERANCE = 2e-3  # metres
_FACING = (0.15, 0.5)  # cosine to the line of sight: not counted below, in full above
_DEPTH_STEP = 2  # pixels of the crop that are one of the depth buffer
_REACH = 1.35  # of the skin around the eyes' middle, in distances between the eyes; without a region "face"


def skin_triangles(assets: HeadAssets) -> Int[np.ndarray, "F 3"]:
    """Triangles of the face, without the eyeballs, and of the ears, which lie behind it and so tell a nod from a shift.

    Those of the regions "face" and "left_ear", "right_ear" where the head model has them, else those in front and near the
    eyes.
    """
    faces = assets.faces.numpy()
    eyeball = (assets.weights[:, [LEFT_EYE, RIGHT_EYE]] > 0.5).any(1).numpy()
    if "face" in assets.regions:
        inside = np.zeros(assets.num_vertices, bool)
        for region in ("face", "left_ear", "right_ear"):
            if region in assets.regions:
                inside[assets.regions[region].numpy()] = True
    else:
        eyes = (assets.joint_regressor @ assets.template).numpy()[[LEFT_EYE, RIGHT_EYE]]
        unit = np.linalg.norm(eyes[0] - eyes[1])
        offset = (assets.template.numpy() - eyes.mean(0)) / unit
        inside = (offset[:, 2] > -0.4) & (offset[:, 1] > -1.9) & (offset[:, 1] < 1.0) & (np.abs(offset[:, 0]) < _REACH)
    return faces[(inside & ~eyeball)[faces].all(1)]


def spread_points(
    assets: HeadAssets, triangles: Int[np.ndarray, "F 3"]
) -> tuple[Int[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """`COUNT` points spread evenly over the triangles of the template: corners and barycentric weights."""
    corners = assets.template.numpy()[triangles].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    rng = np.random.default_rng(0)
    # One point in each equal share of the area, at random within its triangle.
    at = (np.arange(COUNT) + 0.5) / COUNT * area.sum()
    chosen = triangles[np.searchsorted(np.cumsum(area), at).clip(0, len(triangles) - 1)]
    u, v = np.sqrt(rng.random(COUNT)), rng.random(COUNT)
    weights = np.stack((1 - u, u * (1 - v), u * v), axis=-1)
    return torch.from_numpy(chosen), torch.from_numpy(weights)


def seen_weights(
    screen: Float[np.ndarray, "V 3"],
    in_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    corners: Int[np.ndarray, "N 3"],
    barycentric: Float[np.ndarray, "N 3"],
    matte: UInt8[np.ndarray, "h w"],
) -> Float[np.ndarray, " N"]:
    """How much each point counts in one frame, 0 to 1: visible, turned to the camera, in the matte (uint8).

    `screen` are the vertices in the matte's pixels with their depth in metres, `in_camera` in camera space.
    """
    h, w = matte.shape
    coarse = screen * np.array([1 / _DEPTH_STEP, 1 / _DEPTH_STEP, 1.0])
    depth = rasterize_mesh(coarse, faces, -(-h // _DEPTH_STEP), -(-w // _DEPTH_STEP)).depth
    at = np.einsum("nk,nkc->nc", barycentric, screen[corners])
    column, row = np.floor(at[:, 0]).astype(int), np.floor(at[:, 1]).astype(int)
    inside = (column >= 1) & (column < w - 1) & (row >= 1) & (row < h - 1)
    column, row = column.clip(0, w - 1), row.clip(0, h - 1)
    p = in_camera[corners]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    middle = p.mean(1)
    cosine = -(normal * middle).sum(-1) / np.maximum(
        np.linalg.norm(normal, axis=-1) * np.linalg.norm(middle, axis=-1), 1e-12
    )
    facing = np.clip((cosine - _FACING[0]) / (_FACING[1] - _FACING[0]), 0.0, 1.0)
    nearest = depth[row // _DEPTH_STEP, column // _DEPTH_STEP]
    visible = (nearest == 0) | (at[:, 2] <= nearest + _DEPTH_TOLERANCE)
    return np.where(inside & visible, facing * (matte[row, column] / 255.0), 0.0)
