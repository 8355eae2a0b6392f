"""What tells the offset between images and tracking: features of masks, frames that move, and how sure a difference is."""

from __future__ import annotations

import numpy as np
import pytest
from some_tracks import track

from data_prep.prepare import frame_offset
from data_prep.prepare.frame_offset import (
    _candidates,
    _frames_with_motion,
    _head_features,
    _mask_residuals,
    _misfits,
    _mouth_features,
    _standard_errors,
)


def box(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros((16, 20), bool)
    mask[rows, columns] = True
    return mask


def test_a_head_is_its_centre_and_area_above_the_cut_in_widths() -> None:
    mask = box(slice(2, 14), slice(4, 9))
    np.testing.assert_allclose(_head_features(mask, 1.0) * 20, [6.0, 7.5, 60 / 20])
    np.testing.assert_allclose(_head_features(mask, 0.5) * 20, [6.0, 4.5, 30 / 20])
    assert np.isnan(_head_features(mask, 0.1)).tolist() == [True] * 3


def test_a_mouth_is_its_centre_and_extent_in_widths() -> None:
    mask = box(slice(2, 8), slice(4, 9))
    expected = [6.0, 4.5, np.std(np.arange(4, 9)), np.std(np.arange(2, 8))]
    np.testing.assert_allclose(_mouth_features(mask) * 20, expected)
    assert np.isnan(_mouth_features(box(slice(0), slice(0)))).tolist() == [True] * 4
    assert len(_mouth_features(None)) == 0


def test_offsets_about_the_same_number_and_about_a_common_start_are_tried() -> None:
    assert _candidates(range(5, 20), range(3, 20)) == [*range(-4, 7)]
    assert _candidates(range(43, 50), range(3, 20)) == [*range(-4, 6), *range(36, 45)]


def test_the_frames_before_the_largest_movements_are_sampled_but_no_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_offset, "SAMPLED_FRAMES", 3)
    steps = {2: 0.02, 5: 0.05, 6: 0.04, 9: 0.03}
    tracks, depth = {}, 0.8
    for number in range(1, 14):
        tracks[number] = track(t=np.array([0.0, 0.0, depth]), expression=np.array([float(number > 11), 0, 0, 0]))
        depth += steps.get(number, 0.0)
    assert _frames_with_motion(tracks, use_mouth=False) == [2, 5, 9]
    assert _frames_with_motion(tracks, use_mouth=True) == [5, 9, 11]
    few = {number: tracks[number] for number in (1, 2, 3, 5)}
    assert _frames_with_motion(few, use_mouth=True) == [1, 2, 3, 5]


def test_misfits_are_in_units_of_the_best_offsets_own_and_single_ones_do_not_decide() -> None:
    best = {n: np.array([0.5 * (-1) ** n, 2.0]) for n in range(9)} | {9: np.array([99.0, 2.0])}
    other = {n: np.array([1.0, 4.0]) for n in range(10)}
    found = _misfits({0: best, 1: other, 2: {n: best[n] for n in range(5)}})
    unit = 1 / 1.4826**2
    assert found.keys() == {0, 1}  # of too few common frames there is none
    assert list(found[0].values()) == pytest.approx([unit] * 9 + [(9 + unit) / 2], rel=1e-3)
    assert list(found[1].values()) == pytest.approx([4 * unit] * 10, rel=1e-3)


@pytest.mark.parametrize(
    ("gain", "independent"),
    [
        (np.tile([1.0, 2.0], 20), 40.0),  # neighbours that differ are no more than independent
        (np.linspace(0.0, 1.0, 40), 40 * 0.1 / 1.9),  # at the most alike
        (np.tile([0.0, 0.0, 1.0, 1.0], 10), 40.0),
        (np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 1.0], 10), 60 * (1 - 19.75 / 60) / (1 + 19.75 / 60)),
    ],
)
def test_neighbours_that_are_alike_count_less(gain: np.ndarray, independent: float) -> None:
    expected = gain.mean() / (gain.std(ddof=1) / np.sqrt(independent))
    assert _standard_errors(gain) == pytest.approx(expected, rel=0.03)


def test_what_the_pose_explains_is_taken_out_and_frames_without_a_feature_are_left_out() -> None:
    predicted = {n: np.random.default_rng(n).normal(size=2) for n in range(200)}
    observed = {n + 1: 3.0 + 0.5 * values + 0.25 * values[::-1] for n, values in predicted.items()}
    predicted[7] = np.array([0.0, np.nan])
    observed[10] = np.array([np.nan, 0.0])
    found = _mask_residuals(predicted, observed, [1, 190, 196])
    assert found.keys() == {1, 190}  # 5 common frames are too few
    assert found[1].keys() == predicted.keys() - {7, 9}
    assert np.abs(list(found[1].values())).max() < 0.1 < np.abs(list(found[190].values())).max()
