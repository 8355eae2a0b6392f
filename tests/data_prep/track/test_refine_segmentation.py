"""Closed-form matting, and the mattes that it makes sharp."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.raw_video import make_room
from avatar.demo.render import Renderer
from data_prep.track.mattes import closed_form_matting
from data_prep.track.mattes.closed_form_matting import band_radius, closed_form, within_limits
from data_prep.track.mattes.refine_segmentation import sharpened

NOISE, TRUST = 3e-3, 1e-3


def disc(size: int, radius: float) -> np.ndarray:
    """The share of every pixel that a disc covers."""
    big = np.zeros((8 * size, 8 * size), np.float32)
    cv2.circle(big, (4 * size, 4 * size), round(8 * radius), 1.0, -1)
    return cv2.resize(big, (size, size), interpolation=cv2.INTER_AREA)


def over(share: np.ndarray, front: tuple[float, ...], behind: tuple[float, ...]) -> np.ndarray:
    picture = share[..., None] * np.array(front) + (1 - share[..., None]) * np.array(behind)
    shade = np.linspace(0.8, 1.1, len(share))[:, None, None]  # a window is no longer of two colours
    return np.clip(np.rint(picture * shade), 0, 255).astype(np.uint8)


def around(share: np.ndarray, radius: int) -> np.ndarray:
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return cv2.morphologyEx((share > 0.5).astype(np.uint8), cv2.MORPH_GRADIENT, kernel) > 0


def test_the_edge_of_a_disc_is_found_again() -> None:
    """From a guess that is a pixel and a half too wide."""
    truth, wide = disc(64, 20.0), disc(64, 21.5)
    band = around(wide, 3)
    found = closed_form(over(truth, (200, 120, 60), (40, 60, 130)), wide, band)
    assert np.abs(found - truth)[band].mean() < 0.1 * np.abs(wide - truth)[band].mean()
    np.testing.assert_array_equal(found[~band], wide[~band])
    assert found.min() >= 0.0 and found.max() <= 1.0


def test_where_colours_say_nothing_the_guess_stays_smooth() -> None:
    guess = cv2.GaussianBlur(disc(64, 20.0), (0, 0), 1.5)
    found = closed_form(np.full((64, 64, 3), 90, np.uint8), guess, around(guess, 2))
    assert np.abs(found - guess).max() < 0.2


def dense(image: np.ndarray, guess: np.ndarray, band: np.ndarray) -> np.ndarray:
    """The same by the paper's formula (12), window by window."""
    height, width = band.shape
    laplacian = np.zeros((band.size, band.size))
    numbers = np.arange(band.size).reshape(height, width)
    colours = image / 255.0
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            at = np.s_[row - 1 : row + 2, column - 1 : column + 2]
            if not band[at].any():
                continue
            members, window = numbers[at].ravel(), colours[at].reshape(9, 3)
            spread = window - window.mean(0)
            inverse = np.linalg.inv(spread.T @ spread / 9 + NOISE**2 * np.eye(3))
            laplacian[np.ix_(members, members)] += np.eye(9) - (1 + spread @ inverse @ spread.T) / 9
    inside, result = band.ravel(), guess.astype(np.float64).ravel()
    right = TRUST * result[inside] - laplacian[np.ix_(inside, ~inside)] @ result[~inside]
    result[inside] = np.linalg.solve(laplacian[np.ix_(inside, inside)] + TRUST * np.eye(inside.sum()), right)
    return result.reshape(height, width).clip(0, 1)


def test_the_sparse_system_is_the_papers() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (14, 12, 3)).astype(np.uint8)
    guess, band = rng.random((14, 12)).astype(np.float32), rng.random((14, 12)) < 0.4
    band[[0, -1]] = band[:, [0, -1]] = False
    np.testing.assert_allclose(closed_form(image, guess, band, NOISE, TRUST), dense(image, guess, band), atol=2e-4)


def test_no_band_and_one_that_is_none_leave_the_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    image, guess = over(disc(64, 20.0), (200, 120, 60), (40, 60, 130)), disc(64, 22.0)
    np.testing.assert_array_equal(closed_form(image, guess, np.zeros((64, 64), bool)), guess)
    border = np.ones((64, 64), bool)
    border[1:-1, 1:-1] = False
    np.testing.assert_array_equal(closed_form(image, guess, border), guess)
    assert (closed_form(image, guess, np.ones((64, 64), bool)) != guess).any()
    monkeypatch.setattr(closed_form_matting, "_MOST_UNKNOWN", 1000)
    np.testing.assert_array_equal(closed_form(image, guess, np.ones((64, 64), bool)), guess)


@pytest.mark.parametrize("size", [(2, 2), (1, 40), (3, 3)])
def test_tiny_pictures_are_matted_too(size: tuple[int, int]) -> None:
    guess = np.full(size, 0.5, np.float32)
    found = closed_form(np.zeros((*size, 3), np.uint8), guess, np.ones(size, bool))
    assert found.shape == size and np.isfinite(found).all()


def test_large_pictures_are_refined_smaller() -> None:
    seen = []

    def refine(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        seen.append((image.shape, mask.shape))
        return mask

    mask = np.zeros((600, 2048), np.uint8)
    mask[:, :1024] = 255
    refined = within_limits(refine, np.zeros((600, 2048, 3), np.uint8), mask)
    assert seen == [((300, 1024, 3), (300, 1024))] and refined.shape == mask.shape
    np.testing.assert_array_equal(refined[:, :1020], 255)
    assert not refined[:, 1028:].any()
    small = np.zeros((300, 1024), np.uint8)
    assert within_limits(refine, np.zeros((300, 1024, 3), np.uint8), small) is small
    assert [band_radius(side, 100) for side in (48, 384, 512, 1024)] == [1, 1, 2, 3]


def test_a_networks_matte_becomes_sharp_around_the_head_alone() -> None:
    """The demo person in a room; the network's matte is the true one at 128 pixels, and a pixel to the right."""
    size, renderer, performance = 384, Renderer(sample_identity(3)), perform(3, 2, "speech")
    camera = frame_camera(performance, 1, size)
    picture = renderer.render(frame_params(performance, 1), camera)
    share = picture.alpha[..., None] / 255.0
    image = np.rint(picture.image * share + make_room(size, 3) * (1 - share)).clip(0, 255).astype(np.uint8)
    moved = np.roll(picture.alpha, 1, axis=1)
    coarse = cv2.resize(cv2.resize(moved, (128, 128), interpolation=cv2.INTER_AREA), (size, size))
    mouth = np.argwhere(picture.mouth > 127)[:, ::-1]
    points = np.stack((mouth.min(0), mouth.max(0))).astype(float) + np.array(
        [[-40, -90], [40, 30]]
    )  # about a face's box
    made = sharpened(image, coarse, points)
    head = cv2.dilate(picture.head, np.ones((9, 9), np.uint8)) > 0

    def error(matte: np.ndarray) -> float:
        return float(np.abs(matte.astype(float) - picture.alpha)[head].mean())

    assert error(made) < 0.4 * error(coarse)
    near = np.zeros((size, size), bool)
    (left, top), (right, bottom) = points.min(0), points.max(0)
    side = max(right - left, bottom - top)
    near[: int(bottom + 0.6 * side) + 1, max(0, int(left - 0.5 * side)) : int(right + 0.5 * side) + 1] = True
    np.testing.assert_array_equal(made[~near], coarse[~near])
    assert not near.all()
    np.testing.assert_array_equal(sharpened(image, coarse, points), made)
    np.testing.assert_array_equal(sharpened(image, coarse, points * np.nan), coarse)
    np.testing.assert_array_equal(sharpened(image, coarse, points + 1e6), coarse)
