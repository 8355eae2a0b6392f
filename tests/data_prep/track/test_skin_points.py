"""Which points of the skin are seen: in front, turned to the camera, in the matte."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from heads import grid_head

from data_prep.track.fit.skin_points import seen_weights, skin_triangles

SIZE, FOCAL = 101, 400.0  # an odd size: the depth buffer is of half of it
# Two squares of 0.1 m that face the camera, one 0.05 m behind a half of the other; and a steep one at their right.
FRONT = np.array([[-0.08, -0.05, 1.0], [0.02, -0.05, 1.0], [0.02, 0.05, 1.0], [-0.08, 0.05, 1.0]])
BEHIND = FRONT + np.array([0.05, 0.0, 0.05])
STEEP = np.array([[0.09, -0.05, 1.0], [0.09, -0.05, 1.3], [0.09, 0.05, 1.3], [0.09, 0.05, 1.0]])
SQUARE = np.array([[0, 2, 1], [0, 3, 2]])
FACES = np.concatenate((SQUARE, SQUARE + 4, SQUARE + 8))


def weights(matte: np.ndarray) -> np.ndarray:
    """Of the middles of all triangles."""
    at = np.concatenate((FRONT, BEHIND, STEEP))
    screen = np.column_stack((FOCAL * at[:, :2] / at[:, 2:] + SIZE / 2, at[:, 2]))
    middles = np.full((len(FACES), 3), 1 / 3)
    return seen_weights(screen, at, FACES, FACES, middles, matte)


def test_points_in_front_count_and_hidden_and_steep_ones_do_not() -> None:
    found = weights(np.full((SIZE, SIZE), 255, np.uint8))
    assert found[:2].tolist() == [1.0, 1.0]
    # The first triangle behind is the right upper one, which the front does not reach; the other's middle is covered.
    middles = np.concatenate((FRONT, BEHIND))[FACES[2:4]].mean(1)
    is_covered = middles[:, 0] / middles[:, 2] < FRONT[1, 0]
    assert is_covered.tolist() == [False, True]
    assert found[2:4].tolist() == [1.0, 0.0]
    assert found[4:].max() < 0.2


def test_points_count_as_far_as_the_matte_has_them() -> None:
    matte = np.full((SIZE, SIZE), 51, np.uint8)
    np.testing.assert_allclose(weights(matte)[:2], 0.2)


def test_ears_count_as_skin_where_the_head_model_knows_them() -> None:
    head = grid_head()
    face, ear = head.faces[:4].unique(), head.faces[-3:].unique()

    def vertices(**regions: torch.Tensor) -> set[int]:
        return set(skin_triangles(replace(head, regions=regions)).ravel().tolist())

    eyeballs = set(torch.nonzero((head.weights[:, 3:] > 0.5).any(1)).ravel().tolist())
    alone, with_ear = vertices(face=face), vertices(face=face, left_ear=ear)
    assert alone and alone <= set(face.tolist()) - eyeballs
    assert with_ear - alone and with_ear - alone <= set(ear.tolist()) - eyeballs
