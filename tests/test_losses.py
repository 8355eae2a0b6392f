"""The training loss against its written-out formula, its exact shortcuts and its gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from avatar.losses import dssim, masked_huber, masked_lpips, on_crop, photometric_loss
from avatar.metrics import ssim


def huber_written_out(image: Tensor, target: Tensor, delta: float) -> float:
    total = 0.0
    for a, b in zip(image.flatten().tolist(), target.flatten().tolist(), strict=True):
        d = abs(a - b)
        total += 0.5 * d * d if d < delta else delta * (d - delta / 2)
    return total / image.numel()


def sample(height: int = 24, width: int = 31) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    image, target = torch.rand(2, height, width, 3, dtype=torch.float64)
    mouth, head = torch.zeros(2, height, width, dtype=torch.float64)
    mouth[14:19, 11:22] = torch.rand(5, 11, dtype=torch.float64)
    head[3:22, 4:28] = torch.rand(19, 24, dtype=torch.float64)
    return image, target, mouth, head


def test_terms_equal_the_formula_over_the_whole_frame() -> None:
    image, target, mouth, head = sample()
    terms = photometric_loss(image, target, mouth, head)
    assert terms.frame.item() == pytest.approx(huber_written_out(image, target, 0.1), rel=1e-12)
    expected = 40 * huber_written_out(image * mouth[..., None], target * mouth[..., None], 0.1)
    assert terms.mouth.item() == pytest.approx(expected, rel=1e-12)
    assert terms.perceptual.item() == 0.0
    assert terms.total.item() == pytest.approx(terms.frame.item() + terms.mouth.item(), rel=1e-12)


def test_dssim_on_the_box_equals_dssim_of_the_masked_frame() -> None:
    image, target, _, head = sample(60, 47)
    for rows, columns in ((slice(0, 60), slice(0, 47)), (slice(25, 35), slice(20, 24)), (slice(0, 3), slice(44, 47))):
        mask = torch.zeros_like(head)
        mask[rows, columns] = torch.rand(60, 47, dtype=torch.float64)[rows, columns]
        expected = (1 - ssim(image * mask[..., None], target * mask[..., None])) / 2
        assert dssim(image, target, mask).item() == pytest.approx(expected.item(), rel=1e-9, abs=1e-15)


def test_perceptual_term_has_its_weight_and_sees_masked_images() -> None:
    image, target, mouth, head = sample()
    seen: list[Tensor] = []

    def distance(a: Tensor, b: Tensor) -> Tensor:
        seen.extend((a, b))
        return (a - b).abs().sum()

    terms = photometric_loss(image, target, mouth, head, perceptual=masked_lpips(distance))
    torch.testing.assert_close(seen[0], image * head[..., None])
    torch.testing.assert_close(seen[1], target * head[..., None])
    assert terms.perceptual.item() == pytest.approx(0.05 * (seen[0] - seen[1]).abs().sum().item())
    assert terms.total.item() == pytest.approx(sum(term.item() for term in terms[1:]))


@pytest.mark.parametrize("perceptual", [None, dssim], ids=["huber", "huber and D-SSIM"])
def test_gradient_agrees_with_finite_differences(perceptual) -> None:
    image, target, mouth, head = (tensor[10:23, 6:18] for tensor in sample())
    image = image.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, target, mouth, head, perceptual=perceptual).total, (image,), atol=1e-8
    )


def test_a_hidden_mouth_gives_a_zero_gradient() -> None:
    image, target, mouth, head = sample()
    image.requires_grad_()
    loss = masked_huber(image, target, torch.zeros_like(mouth), delta=0.1) + dssim(
        image, target, torch.zeros_like(head)
    )
    loss.backward()
    assert loss.item() == 0.0
    assert image.grad is not None and not image.grad.any()


def test_sizes_that_disagree_are_named() -> None:
    image, target, mouth, head = sample()
    with pytest.raises(ValueError, match=r"mouth_mask has H = 20, but image has H = 24"):
        photometric_loss(image, target, mouth[:20], head)


def test_random_squares_weigh_on_average_what_the_whole_frame_does() -> None:
    """A perceptual term that is a mean over pixels, of an error that is the same everywhere in the mask's box."""
    mask = torch.zeros(40, 60)
    mask[5:35, 10:50] = 1.0
    image, target = torch.full((40, 60, 3), 0.75), torch.full((40, 60, 3), 0.25)

    def mean_error(a, b, m):
        assert a.shape == (16, 16, 3)
        return ((a - b) * m[..., None]).mean()

    generator = np.random.default_rng(0)
    values = [float(on_crop(mean_error, 16, generator)(image, target, mask)) for _ in range(20)]
    whole = float(((image - target) * mask[..., None]).mean())
    assert max(abs(v - whole) for v in values) < 1e-6


def test_a_square_larger_than_head_or_frame_is_cut_to_the_frame_and_no_mask_gives_no_loss() -> None:
    image = torch.rand(20, 30, 3)
    mask = torch.zeros(20, 30)
    mask[18:, 28:] = 1.0
    shapes = []

    def note(a, b, m):
        shapes.append(tuple(a.shape))
        assert m.any(), "the square misses the head"
        return a.mean()

    for seed in range(5):
        on_crop(note, 24, np.random.default_rng(seed))(image, image, mask)
    assert shapes == [(20, 24, 3)] * 5
    assert float(on_crop(note, 24, np.random.default_rng(0))(image, image, torch.zeros(20, 30))) == 0.0
