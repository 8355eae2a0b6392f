"""Values of a tracking, read as data that may be wrong."""

from __future__ import annotations

import numpy as np
import pytest

from data_prep.formats.frame_track import BadFrame, nearest_rotation, pinhole_of, rigid_motion, rows_of, vector
from data_prep.formats.root_pose import rotation_matrix

K = np.array([[200.0, 0.0, 30.0], [0.0, 210.0, 20.0], [0.0, 0.0, 1.0]])
TURN = rotation_matrix(np.array([0.3, -0.2, 0.1]))


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (2, 0), (2, 1), (2, 2)])
def test_a_lens_may_be_off_its_form_by_rounding_alone(place: tuple[int, int]) -> None:
    for off, is_fine in ((0.019, True), (0.021, False), (-0.021, False)):
        lens = K.copy()
        lens[place] += off
        if is_fine:
            assert pinhole_of(lens, "K is").tolist() == [200.0, 210.0, 30.0, 20.0]
        else:
            with pytest.raises(BadFrame, match="K is not of the form"):
                pinhole_of(lens, "K is")


@pytest.mark.parametrize("place", [(0, 0), (1, 1)])
def test_a_lens_has_focal_lengths_above_0(place: tuple[int, int]) -> None:
    lens = K.copy()
    lens[place] = 0.0
    with pytest.raises(BadFrame, match="with positive focal lengths"):
        pinhole_of(lens, "K is")


def test_a_rotation_may_be_off_by_rounding_alone_and_is_no_mirror() -> None:
    np.testing.assert_allclose(nearest_rotation(1.009 * TURN, "R"), TURN, atol=1e-12)
    for wrong in (1.02 * TURN, TURN @ np.diag([1.0, 1.0, -1.0])):
        with pytest.raises(BadFrame, match="R is not a rotation"):
            nearest_rotation(wrong, "R")


def test_a_rigid_motion_ends_with_0_0_0_1() -> None:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, (1, 2, 3)
    R, t = rigid_motion(matrix, "M")
    np.testing.assert_allclose(R, TURN, atol=1e-12)
    assert t.tolist() == [1, 2, 3]
    for column in range(4):
        wrong = matrix.copy()
        wrong[3, column] += 2e-6
        with pytest.raises(BadFrame, match="the last row of M is not 0 0 0 1"):
            rigid_motion(wrong, "M")


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ([1, "2"], "x is not numbers"),
        ([1, [2]], "x is not numbers"),
        (None, "x is not numbers"),
        ([True, False], "x is not numbers"),
        ([1.0], "x has 1 values, not 2"),
        ([1.0, np.nan], r"x is not finite \(1 of 2 values\)"),
        ([np.inf, -np.inf], r"x is not finite \(2 of 2 values\)"),
        ([3e38, -1e39], r"x is not finite \(1 of 2 values\)"),  # in float32
    ],
)
def test_values_that_are_not_so_many_finite_numbers_are_refused(value: object, sentence: str) -> None:
    with pytest.raises(BadFrame, match=sentence):
        vector(value, "x", 2)
    assert vector(np.array([[3], [4]], np.int8), "x", 2).tolist() == [3.0, 4.0] and len(vector([], "x")) == 0


def test_rows_are_one_for_each_frame_whatever_their_axes() -> None:
    values = np.arange(12.0).reshape(3, 1, 4)
    assert rows_of(values, "x", 3, 4).shape == rows_of(values, "x", 3, None).shape == (3, 4)
    for wrong, count, width in ((values, 2, 4), (values, 3, 3), (values[0, 0], 4, None), (values[:, :0], 3, None)):
        with pytest.raises(BadFrame, match="x has the shape"):
            rows_of(wrong, "x", count, width)
