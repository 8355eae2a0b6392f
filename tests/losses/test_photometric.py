"""The training loss against its written-out formula, its exact shortcuts and its gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar.losses.lpips_network import Lpips
from avatar.losses.metrics import grown_box, ssim
from avatar.losses.photometric import (
    CROP_SIZES,
    HEAD_MARGIN,
    crop_of_few_sizes,
    dssim,
    masked_huber,
    masked_lpips,
    on_head,
    photometric_loss,
)


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


@pytest.mark.usefixtures("any_shapes")
def test_sizes_that_disagree_are_named() -> None:
    image, target, mouth, head = sample()
    with pytest.raises(ValueError, match=r"mouth_mask has H = 20, but image has H = 24"):
        photometric_loss(image, target, mouth[:20], head)


def test_the_heads_box_weighs_what_the_whole_frame_does() -> None:
    image, target, _, _ = sample()
    head = torch.zeros(24, 31, dtype=torch.float64)
    head[4:12, 20:28] = torch.rand(8, 8) + 0.01
    seen = []

    def mean_error(a, b, m):
        seen.append(tuple(m.shape))
        return (((a - b) * m[..., None]) ** 2).mean()

    whole = mean_error(image, target, head)
    torch.testing.assert_close(on_head(mean_error, margin=3, least=0)(image, target, head), whole)
    assert seen == [(24, 31), (14, 14)]
    leaf = image.clone().requires_grad_()
    nothing = on_head(mean_error)(leaf, target, torch.zeros(24, 31, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(nothing, leaf)
    assert nothing.item() == 0.0 and not gradient.any()


def test_a_crop_by_rows_and_columns_weighs_what_the_whole_frame_does() -> None:
    image, target, _, _ = sample()
    head = torch.zeros(24, 31, dtype=torch.float64)
    head[4:12, 20:28] = torch.rand(8, 8) + 0.01

    def mean_error(a, b, m):
        return (((a - b) * m[..., None]) ** 2).mean()

    crop = torch.arange(2, 20), torch.arange(13, 31)
    leaves = [image.clone().requires_grad_() for _ in range(2)]
    found, whole = on_head(mean_error)(leaves[0], target, head, crop=crop), mean_error(leaves[1], target, head)
    torch.testing.assert_close(found, whole)
    gradients = [torch.autograd.grad(value, leaf)[0] for value, leaf in zip((found, whole), leaves, strict=True)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("shape", [(512, 512), (288, 360), (40, 33)])
def test_crops_have_few_sizes_and_hold_the_heads_box(shape: tuple[int, int]) -> None:
    sizes = set()
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        corners = [torch.randint(0, side + 1, (2,), generator=generator).sort().values.tolist() for side in shape]
        box = slice(*corners[0]), slice(*corners[1])
        crop, least = crop_of_few_sizes(box, shape), grown_box(box, shape, margin=HEAD_MARGIN)
        for side, inside, size in zip(crop, least, shape, strict=True):
            assert 0 <= side.start <= inside.start and inside.stop <= side.stop <= size
            assert side.stop - side.start >= min(32, size)
        sizes.add(tuple(side.stop - side.start for side in crop))
    assert len(sizes) <= CROP_SIZES**2
    assert {height for height, _ in sizes} <= {*range(64, shape[0], 64), shape[0], 32, *range(45, shape[0], 45)}


@pytest.mark.parametrize("corner", [(0, 0), (70, 20), (97, 60)])
def test_a_head_far_away_gets_a_box_that_lpips_can_see(corner: tuple[int, int]) -> None:
    """3x4 pixels in a frame of 100x64, in a corner of it or not: a box of 32x32 with the head in it, weighed as before."""
    head = torch.zeros(100, 64)
    row, column = corner
    head[row : row + 3, column : column + 4] = 1.0
    image, target = torch.rand(100, 64, 3), torch.rand(100, 64, 3)
    seen = []

    def mean_error(a, b, m):
        seen.append((tuple(m.shape), float(m.sum())))
        return (((a - b) * m[..., None]) ** 2).mean()

    whole = mean_error(image, target, head)
    torch.testing.assert_close(on_head(mean_error, margin=2)(image, target, head), whole)
    assert seen[1] == ((32, 32), 12.0)
    leaf = image.clone().requires_grad_()
    with torch.enable_grad():
        on_head(masked_lpips(Lpips("squeeze")), margin=2)(leaf, target, head).backward()
    assert leaf.grad is not None and bool(leaf.grad.isfinite().all()) and bool(leaf.grad.any())


def test_a_network_sees_in_the_heads_box_nearly_what_it_sees_in_the_frame() -> None:
    y, x = torch.meshgrid(torch.arange(160.0), torch.arange(160.0), indexing="ij")
    head = ((y - 80) ** 2 + (x - 70) ** 2 < 40**2).float()
    image, target = torch.rand(160, 160, 3), torch.rand(160, 160, 3)
    distance = masked_lpips(Lpips("squeeze"))
    with torch.no_grad():
        whole, box = distance(image, target, head), on_head(distance)(image, target, head)
    assert abs(float(box / whole) - 1) < 0.1
