"""Optical flow where the tracked mesh lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from heads import grid_head

from avatar.head.model import HeadModel
from data_prep.prepare.image_motion import _sample, _vertex_groups


def test_flow_is_read_where_the_pixels_have_their_centres() -> None:
    """The flow of the pixel in column i and row j is (i, j), and its centre is at (i + 0.5, j + 0.5)."""
    columns, rows = np.meshgrid(np.arange(12, dtype=np.float32), np.arange(8, dtype=np.float32))
    flow = np.stack((columns, rows), axis=2)
    places = np.array([[0.5, 0.5], [4.5, 6.5], [5.0, 3.75]], np.float32)
    np.testing.assert_allclose(_sample(flow, places), places - 0.5, atol=0.04)  # remap counts 32 parts of a pixel
    np.testing.assert_allclose(_sample(flow, np.array([[-3.0, 99.0]], np.float32)), [[0.0, 7.0]])  # the border goes on


def test_vertices_are_grouped_by_face_lips_and_eyelids() -> None:
    lids = torch.zeros(2, 63, 3)
    lids[0, [3, 4, 5], 1] = torch.tensor([-1.0, -0.6, -0.4])
    regions = {"face": torch.arange(50), "lips": torch.arange(18, 36)}
    head = replace(grid_head(), regions=regions, eyelid_dirs=lids)
    groups = [group.tolist() for group in _vertex_groups(HeadModel(head, torch.zeros(0)))]
    assert groups == [[*range(50)], [*range(27, 36)], [*range(18, 27)], [3, 4]]
    bare = replace(head, regions={}, eyelid_dirs=0 * lids)
    assert _vertex_groups(HeadModel(bare, torch.zeros(0))) == []
