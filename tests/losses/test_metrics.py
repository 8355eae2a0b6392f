"""PSNR and SSIM against scikit-image and torchmetrics, and what masks and borders mean."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from avatar.losses.metrics import bounding_box, psnr, ssim, ssim_map

SKIMAGE = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "channel_axis": 2}


def pair(height: int, width: int, noise: float) -> tuple[Tensor, Tensor]:
    """A smooth picture with flat white parts, as composites have, and a noisy copy."""
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 4, width), indexing="ij")
    image = torch.stack(((3 * x).sin() * y.cos(), (x + y).cos(), (5 * y).sin()), dim=-1) * 0.5 + 0.5
    image[:, : width // 3] = 1.0
    target = image.clone()
    target[:, width // 4 :] += noise * torch.randn(height, width - width // 4, 3)
    return image, target.clamp(0, 1)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (33, 64), (128, 97)])
@pytest.mark.parametrize("noise", [0.001, 0.05, 0.5])
def test_agrees_with_scikit_image(height: int, width: int, noise: float) -> None:
    image, target = pair(height, width, noise)
    a, b = image.double().numpy(), target.double().numpy()
    assert psnr(image, target).item() == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1.0), abs=1e-9)
    assert ssim(image, target).item() == pytest.approx(structural_similarity(a, b, **SKIMAGE), abs=1e-9)


@pytest.mark.parametrize(
    "box",
    [
        (slice(0, 50), slice(0, 71)),
        (slice(20, 31), slice(30, 44)),
        (slice(0, 7), slice(60, 71)),
        (slice(5, 45), slice(9)),
    ],
    ids=["everywhere", "inside", "corner", "side"],
)
def test_masked_ssim_is_the_mean_of_scikit_images_map(box: tuple[slice, slice]) -> None:
    image, target = pair(50, 71, 0.1)
    mask = torch.zeros(50, 71)
    mask[box] = (torch.rand(50, 71) * (torch.rand(50, 71) > 0.4))[box]
    _, full = structural_similarity(image.double().numpy(), target.double().numpy(), full=True, **SKIMAGE)
    inside = full.mean(axis=2)[5:-5, 5:-5]
    expected = np.average(inside, weights=mask[5:-5, 5:-5].numpy())
    assert ssim(image, target, mask).item() == pytest.approx(expected, abs=1e-9)


def test_differs_from_torchmetrics_by_its_border_only() -> None:
    image, target = pair(60, 80, 0.1)
    batches = [tensor.double().permute(2, 0, 1)[None] for tensor in (image, target)]
    padded_mean, padded = structural_similarity_index_measure(*batches, data_range=1.0, return_full_image=True)
    assert ssim(image, target).item() == pytest.approx(padded[..., 5:-5, 5:-5].mean().item(), abs=1e-9)
    assert abs(ssim(image, target).item() - padded_mean.item()) > 1e-3  # the padded windows count in theirs


def test_masked_psnr_counts_the_mask_only() -> None:
    image = torch.zeros(20, 20, 3)
    target = torch.zeros(20, 20, 3)
    target[:10, :10] = 0.1
    mask = torch.zeros(20, 20)
    mask[:10, :10] = 1.0
    assert psnr(image, target, mask).item() == pytest.approx(20.0, abs=1e-5)
    # the trap: multiplied by the mask and averaged over the frame, a mask of a quarter adds 6 dB
    masked = (image * mask[..., None], target * mask[..., None])
    assert psnr(*masked).item() == pytest.approx(20.0 + 10 * np.log10(4), abs=1e-5)


def test_soft_masks_weigh_the_squared_error() -> None:
    image, target = torch.rand(2, 12, 15, 3)
    mask = torch.rand(12, 15)
    error = ((image - target).double() ** 2).numpy().mean(axis=2)
    expected = -10 * np.log10((error * mask.numpy()).sum() / mask.numpy().sum())
    assert psnr(image, target, mask).item() == pytest.approx(expected, abs=1e-6)


def test_equal_images_and_empty_masks() -> None:
    image, _ = pair(30, 30, 0.1)
    assert psnr(image, image).item() == float("inf")
    for same in (image, torch.zeros(30, 30, 3), torch.ones(30, 30, 3)):
        assert ssim(same, same).item() == pytest.approx(1.0, abs=1e-12)
    assert psnr(image, image, torch.zeros(30, 30)).isnan()
    assert ssim(image, image, torch.zeros(30, 30)).isnan()
    border = torch.zeros(30, 30)
    border[:, 27:] = 1.0  # no whole window is centred there
    assert ssim(image, image, border).isnan()


def test_map_is_centred_on_its_pixel_and_differentiable() -> None:
    image = torch.zeros(31, 31, 3, dtype=torch.float64, requires_grad=True)
    target = torch.zeros(31, 31, 3, dtype=torch.float64)
    target[20, 12] = 1.0
    similarity = ssim_map(image, target)
    assert similarity.shape == (21, 21, 3)
    lowest = int(similarity[..., 0].argmin())
    assert divmod(lowest, 21) == (15, 7)
    similarity.sum().backward()
    assert image.grad is not None and image.grad.isfinite().all()


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("function", [psnr, ssim])
def test_sizes_that_disagree_are_named(function) -> None:
    with pytest.raises(ValueError, match="target has W = 12, but image has W = 13"):
        function(torch.zeros(12, 13, 3), torch.zeros(12, 12, 3))
    with pytest.raises(ValueError, match=r"mask has H = 3, but image has H = 12"):
        function(torch.zeros(12, 12, 3), torch.zeros(12, 12, 3), torch.zeros(3, 12))


def test_images_under_the_window_are_refused() -> None:
    with pytest.raises(ValueError, match=r"at least 11 x 11 pixels, got 12 x 10"):
        ssim(torch.zeros(10, 12, 3), torch.zeros(10, 12, 3))


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 6)), max_size=4))
def test_bounding_box_is_the_tightest(pixels: list[tuple[int, int]]) -> None:
    mask = torch.zeros(9, 7)
    for row, column in pixels:
        mask[row, column] = 0.01
    box = bounding_box(mask)
    if not pixels:
        assert box is None
        return
    rows, columns = zip(*pixels, strict=True)
    assert box == (slice(min(rows), max(rows) + 1), slice(min(columns), max(columns) + 1))
