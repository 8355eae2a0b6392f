"""The batched oracle agrees with the reference, and the comparison with it finds small errors."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from stress.random_scenes import random_batch
from stress.test_random_scenes import allowed_and_error, assert_agrees, draw_with_kernel, truth_of

from avatar.splat import splat
from avatar.types import Camera, Gaussians, Rendering

pytestmark = pytest.mark.slow

SEEDS = range(12)


def reference(gaussians: Gaussians, camera: Camera, background: torch.Tensor, **options: Any) -> Rendering:
    return splat(
        Gaussians(*(t.double() for t in gaussians)), camera, background.double(), backend="reference", **options
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_it_agrees_with_the_reference(seed: int) -> None:
    batch = random_batch(seed, scenes=5)
    truth = truth_of(batch, seed)
    found, gradients = draw_with_kernel(batch, truth, reference, torch.float64)
    clear = ~truth.drawn.ambiguous
    torch.testing.assert_close(found.image[clear], truth.drawn.image.detach()[clear], rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(found.alpha[clear], truth.drawn.alpha.detach()[clear], rtol=1e-9, atol=1e-11)
    for name, (error, allowed) in allowed_and_error(truth, gradients).items():
        assert (error <= 1e-4 * allowed).all(), name  # float64 against float64


def with_steeper_gradients(*arguments: Any, **options: Any) -> Rendering:
    image, alpha = splat(*arguments, **options)
    return Rendering(image + 1e-2 * (image - image.detach()), alpha)


def with_a_brighter_image(*arguments: Any, **options: Any) -> Rendering:
    image, alpha = splat(*arguments, **options)
    return Rendering(image + 1e-3, alpha)


def with_one_splat_turned_the_other_way(gaussians: Gaussians, *arguments: Any, **options: Any) -> Rendering:
    flipped = gaussians.quats.clone()
    flipped[0] = 2 * gaussians.quats[0].detach() - gaussians.quats[0]  # the same value, the opposite gradient
    return splat(gaussians._replace(quats=flipped), *arguments, **options)


@pytest.mark.parametrize("wrong", [with_steeper_gradients, with_a_brighter_image, with_one_splat_turned_the_other_way])
def test_a_wrong_kernel_is_found(wrong: Any) -> None:
    batch = random_batch(1)
    truth = truth_of(batch, 1)
    assert_agrees(batch, truth, *draw_with_kernel(batch, truth))
    with pytest.raises(AssertionError, match="of scenes"):
        assert_agrees(batch, truth, *draw_with_kernel(batch, truth, wrong))


def test_few_pixels_are_left_out_and_most_gradients_are_held_to_a_fifth() -> None:
    pixels = ambiguous = splats = sharp = 0
    for seed in SEEDS:
        batch = random_batch(seed)
        truth = truth_of(batch, seed)
        ambiguous += int(truth.drawn.ambiguous.sum())
        pixels += truth.drawn.ambiguous.numel()
        nothing = {name: torch.zeros_like(gradient) for name, gradient in truth.gradients.items()}
        for size, allowed in allowed_and_error(truth, nothing).values():  # the error is the gradient itself
            splats += int((size > 0).sum())
            sharp += int((allowed < 0.2 * size)[size > 0].sum())
    assert ambiguous < 0.01 * pixels
    assert sharp > 0.6 * splats
