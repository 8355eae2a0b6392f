"""How far a tracking places the face from where it is, in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from avatar.data.recording import Recording
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.track.faces.embedding import iris_embedding
from data_prep.track.faces.landmarks import Landmarks

OUTER_CORNERS, IRISES = (33, 263), (468, 473)  # landmarks


@dataclass(frozen=True)
class Placement:
    """How far the face's vertices are from the true ones in the picture; per cent of the distance between the irises."""

    all: float  # mean over vertices and frames
    constant: float  # of each vertex's mean over the frames
    moving: float  # what remains without that


def placement(assets: HeadAssets, own: Recording, truth: Recording, pairs: Sequence[tuple[int, int]]) -> Placement:
    """How far the face lies from the truth in the picture, over the frames that both have."""
    irises = torch.from_numpy(iris_embedding(assets).corners[:, 0])
    ours, theirs = (HeadModel(assets, recording.identity) for recording in (own, truth))
    residuals, distances = [], []
    for mine, true in pairs:
        placed = own.camera(mine).project(ours.vertices(own.params(mine)))[:, :2]
        expected = truth.camera(true).project(theirs.vertices(truth.params(true)))[:, :2]
        residuals.append((placed - expected)[assets.regions["face"]].numpy())
        distances.append(float((expected[irises[0]] - expected[irises[1]]).norm()))
    # Turned heads show their eyes closer together; the widest tenth is seen from the front.
    return in_parts(100.0 * np.stack(residuals) / np.percentile(distances, 90))


def corners_distance(landmarks: Landmarks) -> float:
    """Between the outer corners of the eyes, which the interocular distance of 300-W is, in distances of the irises."""
    points = landmarks.points[landmarks.detected, :, :2]
    corners, irises = (np.linalg.norm(points[:, a] - points[:, b], axis=-1) for a, b in (OUTER_CORNERS, IRISES))
    return float(np.percentile(corners, 90) / np.percentile(irises, 90))


def in_parts(residuals: Float[np.ndarray, "T V 2"]) -> Placement:
    constant = residuals.mean(0)
    lengths = (np.linalg.norm(part, axis=-1).mean() for part in (residuals, constant, residuals - constant))
    return Placement(*map(float, lengths))
