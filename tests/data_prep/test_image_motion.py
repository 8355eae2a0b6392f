"""Optical flow where the tracked mesh lies."""

from __future__ import annotations

import numpy as np

from data_prep.prepare.image_motion import _sample


def test_flow_is_read_where_the_pixels_have_their_centres() -> None:
    """The flow of the pixel in column i and row j is (i, j), and its centre is at (i + 0.5, j + 0.5)."""
    columns, rows = np.meshgrid(np.arange(12, dtype=np.float32), np.arange(8, dtype=np.float32))
    flow = np.stack((columns, rows), axis=2)
    places = np.array([[0.5, 0.5], [4.5, 6.5], [5.0, 3.75]], np.float32)
    np.testing.assert_allclose(_sample(flow, places), places - 0.5, atol=0.04)  # remap counts 32 parts of a pixel
    np.testing.assert_allclose(_sample(flow, np.array([[-3.0, 99.0]], np.float32)), [[0.0, 7.0]])  # the border goes on
