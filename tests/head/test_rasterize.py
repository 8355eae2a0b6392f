"""Rasterising a mesh: which pixels its triangles cover."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.head.rasterize import rasterize_mesh


@pytest.mark.parametrize("second", [(0, 1, 3), (1, 0, 3), (3, 0, 1)])
def test_an_edge_that_two_triangles_share_has_no_holes(second: tuple[int, int, int]) -> None:
    """Pixels whose centres lie on it."""
    for n in range(2, 60):
        corners = [(0.5, 0.5), (n + 0.5, n + 0.5), (n + 0.5, 0.5), (0.5, n + 0.5)]
        screen = np.array([(x, y, 1.0) for x, y in corners], np.float32)
        drawn = rasterize_mesh(screen, np.array([(0, 1, 2), second], np.int32), n + 1, n + 1)
        assert (drawn.face_id >= 0).all()
        assert (drawn.barycentric >= 0).all() and np.allclose(drawn.barycentric.sum(axis=-1), 1.0)
