"""How much of the surroundings each vertex of a person sees: baked once, by looking at the neutral scene from all sides."""

from __future__ import annotations

import numpy as np
import torch

from avatar.demo import scene
from avatar.head.rasterize import rasterize_mesh
from avatar.types import IDENTITY_6D, HeadParams

VIEWS = 96
MAP_SIZE = 320
REACH = 0.62  # metres of the scene that a map covers
BIAS = 0.0025  # metres


def neutral_params() -> HeadParams:
    """No expression, jaw closed, eyes ahead and open."""
    identity = torch.tensor(IDENTITY_6D)
    return HeadParams(torch.zeros(100), identity, identity.repeat(2), torch.zeros(2), identity)


def ambient_occlusion(performer: scene.Performer) -> np.ndarray:
    """Cosine-weighted visibility [N] in [0, 1] of every point of the person's scene."""
    geometry = performer.pose(neutral_params(), np.eye(3, dtype=np.float32))
    points, normals = geometry.points, geometry.normals
    seen, total = np.zeros(len(points), np.float32), np.full(len(points), 1e-6, np.float32)
    for direction in _directions():
        right = np.cross(np.array([0.31, 0.9, 0.27]), direction)
        right /= np.linalg.norm(right)
        basis = np.stack((right, np.cross(right, direction), -direction)).astype(np.float32)
        on_map = (points - np.array([0.0, -0.03, -0.01], np.float32)) @ basis.T
        on_map[:, :2] = on_map[:, :2] * (MAP_SIZE / REACH) + MAP_SIZE / 2
        on_map[:, 2] += 10.0
        depth = rasterize_mesh(on_map, performer.faces, MAP_SIZE, MAP_SIZE).depth
        column = np.clip(on_map[:, 0].astype(int), 0, MAP_SIZE - 1)
        row = np.clip(on_map[:, 1].astype(int), 0, MAP_SIZE - 1)
        nearest = depth[row, column]
        weight = np.maximum(normals @ direction.astype(np.float32), 0.0)
        total += weight
        seen += weight * ((nearest == 0) | (on_map[:, 2] < nearest + BIAS))
    share = np.clip(seen / total, 0.0, 1.0)
    return _lifted(performer, share)


def _lifted(performer: scene.Performer, share: np.ndarray) -> np.ndarray:
    """Lips and lids shade each other only while closed or at rest: do not bake it in."""
    mesh = performer.head.mesh
    for ring, least in enumerate((0.15, 0.3, 0.38, 0.6, 0.7, 0.7, 0.7)):
        at = mesh.mouth_rings[:, ring]
        share[at] = np.maximum(share[at], least)
    lids = mesh.eye_rings[:, :3]
    share[lids] = np.maximum(share[lids], 0.5)
    # Visibility of a finite set of maps is noisy: two rounds of averaging with the neighbours.
    edges = np.concatenate((performer.faces[:, :2], performer.faces[:, 1:]))
    for _ in range(2):
        total = np.bincount(edges[:, 0], share[edges[:, 1]], len(share)) + np.bincount(
            edges[:, 1], share[edges[:, 0]], len(share)
        )
        count = np.bincount(edges[:, 0], minlength=len(share)) + np.bincount(edges[:, 1], minlength=len(share))
        share = 0.4 * share + 0.6 * np.where(count > 0, total / np.maximum(count, 1), share)
    return share.astype(np.float32)


def _directions() -> np.ndarray:
    """Directions [VIEWS, 3] spread evenly over the sphere by the golden angle."""
    k = np.arange(VIEWS) + 0.5
    height, turn = 1.0 - 2.0 * k / VIEWS, k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    return np.stack((flat * np.cos(turn), height, flat * np.sin(turn)), -1)
