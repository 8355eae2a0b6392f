"""How ARKit's blendshape scores move an avatar in browsers, and how far: what `avatar view --stream` does, as a table."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from avatar.head.expression_names import plain
from avatar.head.model import matrix_from_6d
from avatar.motion.controls import shown_range
from avatar.motion.drive_csv import from_blendshapes
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.packets import BLENDSHAPES

DIGITS = 6


def face_map(trained: TrainedAvatar, kept: list[int]) -> dict[str, Any]:
    """The places are expression coefficients `kept`, then the jaw's rotation vector 3, the eyes' 6, eyelids 2.

    `blendshapes`: for each of ARKit's names (mouthSmileLeft) that moves something, pairs of place and weight.
    `low`, `high`: how far a place may leave the neutral face, as the training frames did.
    """
    count, assets = len(BLENDSHAPES), trained.assets
    one_each = {plain(name): row for name, row in zip(BLENDSHAPES, np.eye(count), strict=True)}
    arrays, _ = from_blendshapes(one_each, count, assets.num_expressions, assets.names)
    weights = np.concatenate(
        (arrays["expression"][:, kept], arrays["jaw"], arrays["eyes"], arrays["eyelids"]), axis=1
    ).round(DIGITS)
    ranges = [shown_range(values) for values in offsets_from_neutral(trained, kept).T]
    return {
        "blendshapes": {
            name[0].lower() + name[1:]: [[int(place), float(row[place])] for place in row.nonzero()[0]]
            for name, row in zip(BLENDSHAPES, weights, strict=True)
            if row.any()
        },
        "low": [round(low, DIGITS) for low, _ in ranges],
        "high": [round(high, DIGITS) for _, high in ranges],
    }


def offsets_from_neutral(trained: TrainedAvatar, kept: list[int]) -> np.ndarray:
    """How far the training frames are from the neutral face, [T, E + 11], in the order of `face_map`."""
    tracks, train = trained.recording.tracks, trained.recording.times(trained.recording.split.train)
    neutral = trained.neutral
    jaw = neutral.jaw.T @ matrix_from_6d(tracks["jaw"][train])
    eyes = matrix_from_6d(tracks["eyes"][train].reshape(-1, 2, 6))
    moved = (
        (tracks["expression"][train] - neutral.expression)[:, kept],
        rotation_matrix_to_axis_angle(jaw),
        rotation_matrix_to_axis_angle(eyes.reshape(-1, 3, 3)).reshape(-1, 6),
        tracks["eyelids"][train],
    )
    return torch.cat(moved, dim=1).double().numpy()
