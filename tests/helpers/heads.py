"""A small head model with every part that FLAME has, for tests of what is built on top of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from avatar.head.assets import HeadAssets
from avatar.types import IDENTITY_6D, HeadParams

EXPRESSIONS = 5


def grid_head(rows: int = 7, columns: int = 9, seed: int = 0) -> HeadAssets:
    """A bent sheet of rows x columns vertices with random bases; the bottom row is the boundary."""
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    points = np.stack((0.2 * (u - 0.5), 0.2 * (v - 0.5), 0.1 * np.cos(2 * (u - 0.5))), axis=-1).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    faces = np.concatenate(
        (
            np.stack((corner, corner + 1, corner + columns), axis=1),
            np.stack((corner + 1, corner + columns + 1, corner + columns), axis=1),
        )
    )
    V, J = len(points), 5
    weights = rng.random((V, J))
    regressor = rng.random((J, V))

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float32))

    return HeadAssets(
        template=tensor(points),
        faces=torch.from_numpy(faces),
        shape_dirs=tensor(0.01 * rng.standard_normal((V, 3, 300))),
        expression_dirs=tensor(0.01 * rng.standard_normal((V, 3, EXPRESSIONS))),
        pose_dirs=tensor(0.003 * rng.standard_normal((V, 3, 9 * (J - 1)))),
        joint_regressor=tensor(regressor / regressor.sum(1, keepdims=True)),
        weights=tensor(weights / weights.sum(1, keepdims=True)),
        parents=(-1, 0, 1, 1, 1),
        eyelid_dirs=tensor(0.01 * rng.standard_normal((2, V, 3))),
        uvs=tensor(0.05 + 0.9 * np.stack((u, v), axis=-1).reshape(-1, 2)),
        uv_faces=torch.from_numpy(faces.copy()),
        regions={"boundary": torch.arange(columns), "lips": torch.arange(2 * columns, 3 * columns)},
        fingerprint=f"grid {rows} {columns} {seed}",
    )


def random_params(seed: int = 0, expressions: int = EXPRESSIONS) -> HeadParams:
    """Every part of a pose away from rest."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    identity = torch.tensor(IDENTITY_6D)
    return HeadParams(
        expression=noise(expressions),
        jaw=identity + 0.3 * noise(6),
        eyes=identity.repeat(2) + 0.3 * noise(12),
        eyelids=torch.rand(2, generator=generator),
        neck=identity + 0.2 * noise(6),
    )


def rest_params(expressions: int = EXPRESSIONS) -> HeadParams:
    identity = torch.tensor(IDENTITY_6D)
    return HeadParams(torch.zeros(expressions), identity, identity.repeat(2), torch.zeros(2), identity)


MOUTH_ROW, MOUTH_COLUMNS = 6, (5, 25)  # of `mouth_head`
OPEN, SMILE, BROWS = range(3)  # its expressions


def mouth_head() -> HeadAssets:
    """A face 60 mm wide, 2 mm between vertices, with a mouth of 40 mm that opens.

    Expression OPEN lowers the lower lip by 10 mm in the middle, SMILE draws the corners outwards, BROWS lifts the upper
    rim; the jaw carries what is below the lips.
    """
    head = grid_head(13, 31)
    rows, columns = np.divmod(np.arange(13 * 31), 31)
    x, y = (columns - 15) * 0.002, (MOUTH_ROW - rows) * 0.002
    points = np.stack((x, y, 0.1 - 10 * x**2), axis=1)
    left, right = MOUTH_COLUMNS
    line = np.flatnonzero((rows == MOUTH_ROW) & (columns > left) & (columns < right))
    V = len(points)
    own = np.concatenate((np.arange(V), line))  # the lower lip's vertices are copies of the upper lip's
    lower_copy = np.arange(V)
    lower_copy[line] = V + np.arange(len(line))
    faces = head.faces.numpy().copy()
    is_below = rows[faces].max(axis=1) > MOUTH_ROW
    faces[is_below] = lower_copy[faces[is_below]]
    lower = np.concatenate((rows > MOUTH_ROW, np.ones(len(line), bool)))
    points, x, y = points[own], points[own, 0], points[own, 1]
    near = np.clip(1 - (x / 0.02) ** 2, 0, None)
    moves = np.zeros((len(points), 3, 3), np.float32)
    moves[:, 1, OPEN] = -0.010 * near * lower
    moves[:, 0, SMILE] = 0.2 * x
    moves[:, 1, BROWS] = 0.5 * np.clip(y, 0, None)
    weights = np.zeros((len(points), 5), np.float32)
    weights[:, 2] = lower * near
    weights[:, 0] = 1 - weights[:, 2]
    lips = np.flatnonzero((abs(y) < 0.005) & (abs(x) < 0.0215))
    zeros = torch.zeros
    return replace(
        head,
        template=torch.from_numpy(points.astype(np.float32)),
        faces=torch.from_numpy(faces),
        shape_dirs=zeros(len(points), 3, 300),
        expression_dirs=torch.from_numpy(moves),
        pose_dirs=zeros(len(points), 3, 36),
        joint_regressor=torch.full((5, len(points)), 1 / len(points)),
        weights=torch.from_numpy(weights),
        eyelid_dirs=zeros(2, len(points), 3),
        uvs=head.uvs[own],
        uv_faces=torch.from_numpy(faces.copy()),
        regions={"boundary": torch.arange(31), "lips": torch.from_numpy(lips)},
        fingerprint="mouth",
    )
