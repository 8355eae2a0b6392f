"""How far a tracking places the face from where it is, in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from avatar.data.recording import Recording
from avatar.head.assets import HeadAssets
from avatar.head.features import region_or_all
from avatar.head.model import HeadModel
from data_prep.track.faces.embedding import iris_embedding


@dataclass(frozen=True)
class Placement:
    """How far the face's vertices are from the true ones in the picture; per cent of the distance between the irises."""

    all: float  # mean over vertices and frames
    moving: float  # without what is the same in all frames


def placement(assets: HeadAssets, own: Recording, truth: Recording, pairs: Sequence[tuple[int, int]]) -> Placement:
    """How far the face lies from the truth in the picture, over the frames that both have."""
    face = region_or_all(assets, "face")
    irises = torch.from_numpy(iris_embedding(assets).corners[:, 0])
    ours, theirs = (HeadModel(assets, recording.identity) for recording in (own, truth))
    residuals, distances = [], []
    for mine, true in pairs:
        placed = own.camera(mine).project(ours.vertices(own.params(mine)))[:, :2]
        expected = truth.camera(true).project(theirs.vertices(truth.params(true)))[:, :2]
        residuals.append((placed - expected)[face].numpy())
        distances.append(float((expected[irises[0]] - expected[irises[1]]).norm()))
    # Turned heads show their eyes closer together; the widest tenth is seen from the front.
    return in_parts(100.0 * np.stack(residuals) / np.percentile(distances, 90))


def in_parts(residuals: Float[np.ndarray, "T V 2"]) -> Placement:
    lengths = (np.linalg.norm(part, axis=-1).mean() for part in (residuals, residuals - residuals.mean(0)))
    return Placement(*map(float, lengths))
