"""The jitter and the width of an outline, of discs that move."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from data_prep.track.mattes.steadiness import Outline, measure_outline

SIZE, RADIUS = 256, 60.0
RIM = np.exp(1j * np.linspace(0, 2 * np.pi, 40, endpoint=False))


def centre(number: int) -> np.ndarray:
    return np.array([110.0 + 3.0 * number, 125.0 - 0.1 * number**2])


def points_of(number: int) -> np.ndarray:
    """A head's vertices: they reach far below the disc, so that all of it lies above the chin."""
    rim = np.stack((RIM.real, RIM.imag), axis=1) * RADIUS
    return np.concatenate((rim, [[0.0, 1.5 * RADIUS]])) + centre(number)


def disc(number: int, radius: float, soft: float) -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    away = np.hypot(x - centre(number)[0], y - centre(number)[1])
    return np.rint(255 * np.clip((radius - away) / soft + 0.5, 0, 1)).astype(np.uint8)


def measured(matte_of: Callable[[int], np.ndarray], frames: int = 12) -> Outline:
    outline = measure_outline(range(frames), matte_of, lambda n: points_of(n % 12))
    assert outline is not None
    return outline


@pytest.mark.parametrize("soft", [1.5, 6.0])
def test_a_disc_that_moves_with_the_head_has_no_jitter(soft: float) -> None:
    """However soft its edge is."""
    outline = measured(lambda n: disc(n, RADIUS, soft))
    assert outline.jitter < 0.12
    assert outline.width == pytest.approx(2 * 2 / 3 * soft, rel=0.1)  # of a linear edge, at twice the size


@pytest.mark.parametrize("soft", [3.0, 6.0])
def test_jitter_is_how_far_the_outline_moves(soft: float) -> None:
    radii = RADIUS + 0.4 * np.random.default_rng(0).normal(size=60)
    outline = measured(lambda n: disc(n % 12, radii[n], soft), 60)
    second = np.abs(np.diff(radii, n=2))
    assert outline.jitter == pytest.approx(2 * np.mean(second) / np.sqrt(6), rel=0.1)


def test_frames_that_follow_no_other_have_none() -> None:
    assert measure_outline([0, 2, 4], lambda n: disc(n, RADIUS, 2.0), points_of) is None
    assert measure_outline([], lambda n: disc(n, RADIUS, 2.0), points_of) is None


def test_what_flickers_beside_the_head_is_jitter() -> None:
    def with_blotch(number: int) -> np.ndarray:
        matte = disc(number, RADIUS, 1.5)
        x, y = np.rint(centre(number)).astype(int)
        return cv2.circle(matte, (int(x) + 62, int(y)), 8, 255, -1) if number % 4 == 0 else matte

    assert measured(with_blotch).jitter > measured(lambda n: disc(n, RADIUS, 1.5)).jitter + 0.2
