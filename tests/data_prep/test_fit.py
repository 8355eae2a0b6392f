"""How a mesh lies on masks, in pixels of the frame whatever the size that is measured at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import grid_head

from avatar.head.model import HeadModel
from data_prep.prepare.mask_overlap import Mesh, measure_fit, measured_size, share_outside
from data_prep.prepare.projection import lip_faces

SIZE = (40, 30)


def square(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    return np.array([[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]], float)


def mask(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    found = np.zeros(SIZE[::-1], bool)
    found[top:bottom, left:right] = True
    return found


def test_distances_are_in_pixels_of_the_frame() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    screen = np.concatenate((square(10, 5, 30, 25), square(16, 18, 24, 22)))
    mesh = Mesh(screen, np.concatenate((faces, faces + 4)), faces, faces + 4)
    head, mouth = mask(10, 5, 26, 25), mask(19, 18, 27, 22)  # the mesh sticks out by 4, its lips are 3 away
    one, four = (measure_fit(mesh, head, mouth, scale, SIZE) for scale in (1.0, 4.0))
    assert (one.overlap, one.inside, one.mask_ratio) == pytest.approx((0.8, 0.8, 0.8))
    assert (one.mouth, one.size) == pytest.approx((3.0, 20.0)) and one.lips == pytest.approx(5 / 11)
    assert one.overhang == pytest.approx(4.0)
    for name in ("overlap", "inside", "mask_ratio", "lips"):
        assert getattr(four, name) == getattr(one, name)
    for name in ("overhang", "mouth", "size"):
        assert getattr(four, name) == pytest.approx(4 * getattr(one, name))


def test_a_mesh_that_is_not_in_the_picture_overlaps_with_nothing() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = Mesh(square(50, 5, 60, 25), faces, faces, faces, np.arange(4))
    for head in (mask(10, 5, 26, 25), mask(0, 0, 0, 0)):
        found = measure_fit(mesh, head, mask(19, 18, 27, 22), 1.0, SIZE)
        assert (found.overlap, found.inside, found.lips, found.outside) == (0.0, 0.0, 0.0, 1.0)
        assert np.isnan([found.overhang, found.mouth, found.mask_ratio, found.size]).all()
    bare = measure_fit(mesh, None, None, 1.0, SIZE)
    assert np.isnan([bare.overlap, bare.inside, bare.lips]).all() and bare.outside == 1.0


def test_points_on_the_left_and_upper_edge_are_in_the_picture_and_others_are_not() -> None:
    points = np.array([[0, 0, 1], [39.9, 29.9, 1], [40, 5, 1], [5, 30, 1], [-0.1, 5, 1], [5, -0.1, 1]], float)
    assert [share_outside(point[None], *SIZE) for point in points] == [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    assert share_outside(points, *SIZE) == pytest.approx(4 / 6) and share_outside(points[:0], *SIZE) == 0.0


@pytest.mark.parametrize(
    ("size", "measured"), [((200, 100), (200, 100)), ((512, 300), (256, 150)), ((5120, 4), (256, 1))]
)
def test_large_pictures_are_measured_smaller(size: tuple[int, int], measured: tuple[int, int]) -> None:
    assert measured_size(*size) == measured


def test_faces_of_the_lips_have_three_vertices_there() -> None:
    head = HeadModel(grid_head(), torch.zeros(0))
    assert len(lip_faces(head)) == 0  # a single row
    rows = HeadModel(replace(grid_head(), regions={"lips": torch.arange(18, 36)}), torch.zeros(0))
    assert len(lip_faces(rows)) == 16 and set(lip_faces(rows).ravel()) == set(range(18, 36))
    assert lip_faces(HeadModel(replace(grid_head(), regions={}), torch.zeros(0))).shape == (0, 3)
