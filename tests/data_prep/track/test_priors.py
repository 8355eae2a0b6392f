"""What the fit expects of a face before it is seen, and how much landmarks count."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, grid_head

from avatar.head.expression_names import ExpressionNames
from data_prep.track.faces.landmark_groups import LEFT_IRIS, RIGHT_IRIS
from data_prep.track.faces.landmarks import BLENDSHAPES, CLOSED_SCORE, NUM_POINTS, Landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.frame_poses import Columns
from data_prep.track.fit.landmark_fit import faded, point_units
from data_prep.track.fit.priors import BOX, JAW_PER_SCORE, SCORE_SHARE, make_priors

NAMES = ExpressionNames(("mouthSmileLeft", "browInnerUp", "e2", "e3", "e4"))
LIDS = slice(Columns.EYELIDS.start - Columns.HEAD.start, Columns.EYELIDS.stop - Columns.HEAD.start)
FIRST = Columns.EXPRESSION.start - Columns.HEAD.start


def seen(**scores: float) -> Landmarks:
    values = np.zeros((2, len(BLENDSHAPES)), np.float32)
    for name, score in scores.items():
        values[1, BLENDSHAPES.index(name)] = score
    return Landmarks(np.zeros((2, NUM_POINTS, 3), np.float32), values, np.ones(2, bool), (64, 64), 25.0)


def test_scores_are_expected_in_the_coefficients_of_their_names() -> None:
    """By a share, and of blinks wholly; in the frame that has them."""
    found = make_priors(
        seen(mouthSmileLeft=0.8, browInnerUp=0.5, jawOpen=0.4, eyeBlinkRight=0.9),
        NAMES,
        torch.arange(EXPRESSIONS),
        False,
    )
    assert not found.mean[0].any()
    assert found.mean[1, FIRST:].tolist() == pytest.approx([0.8 * SCORE_SHARE, 0.5 * SCORE_SHARE, 0, 0, 0])
    assert found.mean[1, LIDS].tolist() == pytest.approx([0.0, 0.9])
    assert float(found.mean[1, Columns.JAW.start - Columns.HEAD.start]) == pytest.approx(0.4 * JAW_PER_SCORE)


@pytest.mark.parametrize("statistical", [False, True])
def test_blendshapes_stay_in_their_box(statistical: bool) -> None:
    """Principal components go both ways; eyelids have a box in any case, the jaw never."""
    found = make_priors(seen(), NAMES, torch.arange(EXPRESSIONS), statistical)
    low, high = (-torch.inf, torch.inf) if statistical else BOX
    assert found.low[FIRST:].tolist() == [low] * EXPRESSIONS and found.high[FIRST:].tolist() == [high] * EXPRESSIONS
    assert (found.low[LIDS] == BOX[0]).all() and (found.high[LIDS] == BOX[1]).all()
    assert torch.isinf(found.low[: LIDS.start]).all()


@pytest.mark.parametrize("statistical", [False, True])
def test_a_negative_weight_only_widens(statistical: bool) -> None:
    names = ExpressionNames((), {"mouthsmileleft": {"0": 2.0, "1": -2.5}})
    low = make_priors(seen(mouthSmileLeft=0.9), names, torch.arange(EXPRESSIONS), statistical).low[FIRST:]
    assert low[:3].tolist() == ([-torch.inf] * 3 if statistical else [BOX[0], -BOX[1], BOX[0]])


def test_an_iris_counts_as_far_as_its_eye_is_open() -> None:
    landmarks = np.array([4, LEFT_IRIS, RIGHT_IRIS])
    winking = seen(eyeBlinkLeft=CLOSED_SCORE, eyeBlinkRight=CLOSED_SCORE / 2)
    found = faded(torch.tensor([1.0, 4.0, 4.0], dtype=torch.float64), landmarks, winking)
    assert found.tolist() == [[1.0, 4.0, 4.0], [1.0, 0.0, pytest.approx(1.0)]]


def test_landmarks_err_by_a_share_of_the_face_in_the_picture() -> None:
    t = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    near, far = point_units(grid_head(), Pinhole(500.0, 500.0, 32.0, 32.0), t).tolist()
    assert near == pytest.approx(2 * far) and far > 0
    wide = point_units(grid_head(), Pinhole(250.0, 250.0, 32.0, 32.0), t)
    assert wide.tolist() == pytest.approx([near / 2, far / 2])
