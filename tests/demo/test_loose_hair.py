"""Strands thinner than a pixel at the outline of a demo person's hair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.demo.identity import sample_identity
from avatar.demo.loose_hair import draw
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import RenderedFrame, Renderer, background_of, render_frame

SEED, SIZE, FRAME = 2, 256, 20
PERFORMANCE = perform(SEED, FRAME + 1, "turn")
MOMENT = frame_params(PERFORMANCE, FRAME), frame_camera(PERFORMANCE, FRAME, SIZE)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(sample_identity(SEED), has_loose_hair=True)


@pytest.fixture(scope="module")
def loose(renderer: Renderer) -> RenderedFrame:
    return renderer.render(*MOMENT)


@pytest.fixture(scope="module")
def combed() -> RenderedFrame:
    return render_frame(SEED, *MOMENT)


def strand(y: float, depth: float, width: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Screen [1, 3, 3] and widths of a level strand from x = 4 to 16."""
    return np.array([[[x, y, depth] for x in (4.0, 10.0, 16.0)]], np.float32), np.full((1, 3), width, np.float32)


GREY = np.full((1, 3, 3), 0.5, np.float32)


def test_a_strand_covers_its_width_where_nothing_is_nearer() -> None:
    depth = np.zeros((12, 20), np.float32)
    depth[:, 10:13], depth[:, 13:] = 0.5, 2.0  # before the strand, and behind it
    drawn = draw(*strand(5.5, 1.0), GREY, depth)
    assert np.allclose(drawn.clear[5, 5:10], 0.8, atol=0.01) and np.allclose(drawn.clear[5, 13:15], 0.8, atol=0.01)
    assert (drawn.clear[5, 10:13] == 1.0).all() and (drawn.clear[:, [2, 17]] == 1.0).all()
    assert (drawn.clear[[3, 7]] == 1.0).all()
    assert set(drawn.row) == {5} and np.allclose(drawn.colour, 0.5)
    between = draw(*strand(6.0, 1.0), GREY, np.zeros_like(depth)).clear
    assert np.allclose(between[5:7, 6:14], 0.9, atol=0.01)


def test_strands_leave_the_product_of_what_each_leaves() -> None:
    empty = np.zeros((12, 20), np.float32)
    one, wide = strand(5.5, 1.0), strand(5.5, 1.2, 0.5)
    both = [np.concatenate(pair) for pair in (*zip(one, wide, strict=True), (GREY, GREY))]
    alone = [draw(*each, GREY, empty).clear for each in (one, wide)]
    np.testing.assert_allclose(draw(*both, empty).clear, alone[0] * alone[1], atol=1e-5)
    outside = [one[0] + np.array([100.0, 0.0, 0.0], np.float32), one[1]]
    assert (draw(*outside, GREY, empty).clear == 1.0).all()


def test_loose_hair_adds_soft_pixels_around_the_head_and_hides_behind_it(
    loose: RenderedFrame, combed: RenderedFrame
) -> None:
    assert (loose.alpha >= combed.alpha).all() and (loose.head >= combed.head).all()
    soft, hard = ((image.alpha > 12) & (image.alpha < 243) for image in (loose, combed))
    assert soft.sum() > 2.5 * hard.sum()
    added = (loose.alpha > combed.alpha).sum() / (combed.alpha > 0).sum()
    assert 0.02 < added < 0.15
    differs = np.abs(loose.image.astype(int) - combed.image).max(2) > 6
    assert not differs[(combed.mouth > 0) | ((combed.alpha == 255) & (combed.head == 0))].any()
    assert differs.mean() > 0.01


def test_the_alpha_is_the_pictures(loose: RenderedFrame, renderer: Renderer) -> None:
    """Over another background the picture changes by what the alpha lets through."""
    bright = replace(renderer.identity, background=renderer.identity.background * 3.0)
    before, after = (background_of(identity, SIZE, SIZE) for identity in (renderer.identity, bright))
    renderer.identity, own = bright, renderer.identity
    try:
        other = renderer.render(*MOMENT)
    finally:
        renderer.identity = own
    np.testing.assert_array_equal(other.alpha, loose.alpha)
    through = (1.0 - loose.alpha[..., None] / 255.0) * (after - before)
    error = np.abs(other.image - loose.image.astype(float) - through)
    assert np.abs(after - before).mean() > 30.0 and error.max() < 2.0


def test_the_hair_of_a_seed_repeats_and_turns_with_the_head(loose: RenderedFrame, renderer: Renderer) -> None:
    again = Renderer(sample_identity(SEED), has_loose_hair=True)
    np.testing.assert_array_equal(again.render(*MOMENT).image, loose.image)
    points = renderer.performer.pose(MOMENT[0], np.eye(3)).points
    later = renderer.performer.pose(frame_params(PERFORMANCE, 0), np.eye(3)).points
    strands = again._loose
    assert strands is not None
    moved = strands.points(later) - strands.points(points)
    assert np.ptp(moved, axis=1).max() < 1e-6 and np.abs(moved).max() < 4e-3
