"""The regular grid that pictures are put on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from data_prep.track.camera_rig.camera_pictures import Times
from data_prep.track.footage.source import Footage, whole
from data_prep.track.footage.timing import regular_timing


@pytest.mark.parametrize("fps", [24000 / 1001, 25.0, 30000 / 1001, 30.0, 12.5])
@pytest.mark.parametrize("digits", [6, 3])
def test_regular_times(fps: float, digits: int) -> None:
    timing = regular_timing(np.round(3.7 + np.arange(200) / fps, digits))
    assert timing.fps == pytest.approx(fps, rel=1e-9) and not timing.notes
    assert timing.numbers.tolist() == list(range(200))


@pytest.mark.parametrize("fps", [24.1, 24.97, 29.9, 30.05])
def test_a_rate_beside_a_usual_one_stays_where_pictures_would_drift_from_their_numbers(fps: float) -> None:
    times = 3.7 + np.arange(600) / fps
    timing = regular_timing(times, fps)
    assert np.abs(timing.numbers / timing.fps - (times - times[0])).max() < 0.01 / fps
    footage = SimpleNamespace(read=lambda *_: zip(times, range(600), strict=True))
    picked = Times(timing.numbers.tolist(), 3.7, timing.fps).pick(cast(Footage, footage), whole(64, 64))
    assert list(picked) == [(number, number) for number in range(600)]


def test_an_unusual_rate_stays() -> None:
    timing = regular_timing(np.arange(200) / 27.3)
    assert timing.fps == pytest.approx(27.3) and not timing.notes


def test_jitter_of_a_telephone_drops_nothing() -> None:
    rng = np.random.default_rng(0)
    timing = regular_timing(np.arange(300) / 30 + rng.uniform(-0.008, 0.008, 300))
    assert timing.numbers.tolist() == list(range(300)) and timing.fps == 30.0


def test_a_rate_that_changes_once_keeps_the_pictures_at_their_times() -> None:
    """As of a telephone that films fewer pictures in the dark."""
    times = 2.0 + np.r_[np.arange(900) / 30, 30 + np.arange(720) / 24]
    timing = regular_timing(times, 27.0)
    used = timing.numbers >= 0
    assert used.all() and np.abs(timing.numbers / timing.fps - (times - times[0])).max() < 1 / 30
    assert timing.fps == 30.0 and "the frame rate varies (33 to 42 ms" in timing.notes[0]


def test_a_variable_rate_leaves_gaps_and_drops_between() -> None:
    times = np.array([0, 1, 2, 3, 7, 8, 8.3, 8.9, 10, 11, 12, 13]) / 25
    timing = regular_timing(times)
    assert timing.fps == 25.0
    assert timing.numbers.tolist() == [0, 1, 2, 3, 7, 8, -1, 9, 10, 11, 12, 13]
    assert timing.notes == (
        "the frame rate varies (12 to 160 ms from picture to picture): the clip is taken at 25 a second, 1 pictures "
        "between are left out and 3 times have none",
    )


@pytest.mark.parametrize("digits", [6, 3])
@pytest.mark.parametrize("gap", [1.7, 2.4, 2.5, 3.5])
def test_a_gap_that_is_no_whole_number_of_pictures_loses_none_behind_it(gap: float, digits: int) -> None:
    rng = np.random.default_rng(0)
    times = (np.arange(200) + rng.uniform(-0.2, 0.2, 200)) / 30
    times[100:] += gap / 30
    timing = regular_timing(np.round(times, digits), 30.0)
    assert (
        timing.fps == 30.0 and (np.diff(timing.numbers[:100]) == 1).all() and (np.diff(timing.numbers[100:]) == 1).all()
    )
    assert np.abs(timing.numbers - (times - times[0]) * 30).max() < 1


def test_two_distances_that_are_as_common_lose_no_picture() -> None:
    times = np.cumsum([0, *(1 / 30, 4 / 30) * 10])
    timing = regular_timing(times)
    assert timing.fps == 30.0 and timing.numbers.tolist() == np.rint(times * 30).tolist()


def test_times_that_run_backwards() -> None:
    times = np.arange(40) / 25
    times[20] = times[3]
    timing = regular_timing(times)
    kept = timing.numbers[timing.numbers >= 0]
    assert (np.diff(kept) > 0).all() and len(kept) == 39 and timing.fps == 25.0


def test_clips_without_times() -> None:
    assert regular_timing(np.zeros(2), 30.0).fps == 30.0
    timing = regular_timing(np.zeros(50), 24.0)
    assert timing.fps == 24.0 and timing.notes == ("the pictures carry no usable times: 24 a second are assumed",)
    assert timing.numbers.tolist() == list(range(50))
