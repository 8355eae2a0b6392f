"""A camera's pictures become a video of constant rate: each where its time says, whatever the camera skips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from data_prep.live.picture_sources import LivePicture
from data_prep.live.video_recorder import SLACK, VideoRecorder

RATE = 30.0


class Timed:
    """A source whose pictures were taken at these times; each holds its number."""

    name, size, equivalent_focal, silent_after = "a script", (8, 8), None, 5.0

    def __init__(self, times: Sequence[float]) -> None:
        self._times = times

    def pictures(self) -> Iterator[LivePicture]:
        for n, taken in enumerate(self._times):
            yield LivePicture(np.full((8, 8, 3), n, np.uint16), float(taken))

    def close(self) -> None:
        pass


def filmed(times: Sequence[float], rate: float = RATE) -> tuple[VideoRecorder, list[int]]:
    """The film, and the number of the picture in each of its frames."""
    film, frames = VideoRecorder(Timed(times)), []
    film.begin(lambda image: frames.append(int(image[0, 0, 0])), rate)
    assert len(list(film.pictures())) == len(times), "all pictures go on to who watches"
    assert film.frames == len(frames)
    return film, frames


def test_a_steady_camera_is_written_as_it_is() -> None:
    film, frames = filmed(100 + np.arange(90) / RATE)
    assert frames == list(range(90)) and film.repeated == film.left_out == 0


def test_jitter_repeats_and_leaves_out_nothing() -> None:
    jitter = np.random.default_rng(0).uniform(-0.35, 0.35, 300)
    jitter[0] = 0.3
    film, frames = filmed((np.arange(300) + jitter) / RATE)
    assert frames == list(range(300)) and film.repeated == film.left_out == 0


def test_what_the_camera_skips_is_repeated() -> None:
    film, frames = filmed(np.array([0, 1, 2, 6, 7]) / RATE)
    assert frames == [0, 1, 2, 2, 2, 2, 3, 4] and film.repeated == 3 and film.left_out == 0


def test_a_camera_that_is_too_quick_leaves_pictures_out() -> None:
    film, frames = filmed(np.arange(120) / (2 * RATE))
    assert len(frames) == pytest.approx(60, abs=1) and film.left_out == 120 - len(frames) and film.repeated == 0


@pytest.mark.parametrize("rate", [14.2, 28.3, 31.0])
def test_every_picture_is_shown_at_its_time(rate: float) -> None:
    times = np.arange(400) / rate + np.random.default_rng(1).uniform(-0.2, 0.2, 400) / rate
    film, frames = filmed(times)
    numbers, first = np.unique(frames, return_index=True)
    assert np.abs(first - (times[numbers] - times[0]) * RATE).max() <= SLACK + 1e-6
    assert film.frames / RATE == pytest.approx(times[-1] - times[0], abs=2 / RATE)


def test_nothing_is_written_before_it_begins_and_after_it_ends() -> None:
    film, frames = VideoRecorder(Timed(np.arange(9) / RATE)), []
    for n, _ in enumerate(film.pictures()):
        if n == 2:
            film.begin(lambda image: frames.append(int(image[0, 0, 0])), RATE)
        if n == 5:
            film.end()
    assert frames == [3, 4, 5]


@pytest.mark.parametrize(
    ("rate", "expected"), [(29.97, 30), (30.2, 30), (24.9, 25), (15.1, 15), (7.4, 7.5), (17.5, 17.5), (33.0, 33.0)]
)
def test_the_rate_is_the_cameras_own(rate: float, expected: float) -> None:
    """Whatever its jitter, and with a picture missing in between; a common rate where it is near."""
    count = int(3 * rate)
    times = (np.arange(count) + np.random.default_rng(2).uniform(-0.1, 0.1, count)) / rate
    film = VideoRecorder(Timed(np.delete(times, count // 2)))
    for _ in film.pictures():
        pass
    assert film.measured_rate() == pytest.approx(expected, rel=0.02)


def test_a_rate_takes_two_seconds() -> None:
    film = VideoRecorder(Timed(np.arange(61) / RATE))
    rates = [film.measured_rate() for _ in film.pictures()]
    assert rates[:60] == [None] * 60 and rates[60] == 30
