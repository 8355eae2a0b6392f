"""The compiled D-SSIM against the plain one in float64: value, gradient, threads, instruction sets, hard masks."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar.losses.dssim_cpu import dssim_cpu
from avatar.losses.photometric import dssim


def pair(height: int, width: int, noise: float = 0.05) -> tuple[Tensor, Tensor]:
    """A smooth image with texture, and another one near it."""
    ys, xs = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    smooth = 0.5 + 0.4 * torch.stack((torch.sin(xs / 9), torch.cos(ys / 7), torch.sin((xs + ys) / 13)), -1)
    target = (smooth + 0.1 * torch.rand(height, width, 3)).clamp(0, 1)
    return (target + noise * torch.randn(height, width, 3)), target


def value_and_gradient(function, image: Tensor, target: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    image = image.clone().requires_grad_()
    value = function(image, target, mask)
    value.backward()
    assert image.grad is not None
    return value.detach(), image.grad


def assert_like_the_oracle(image: Tensor, target: Tensor, mask: Tensor) -> None:
    value, gradient = value_and_gradient(dssim_cpu, image, target, mask)
    expected, expected_gradient = value_and_gradient(dssim, image.double(), target.double(), mask.double())
    assert value.dtype == gradient.dtype == torch.float32
    assert value.item() == pytest.approx(expected.item(), rel=1e-6, abs=1e-12)
    assert (gradient - expected_gradient).norm() <= 1e-6 * expected_gradient.norm()


def boxed(height: int, width: int, rows: slice, columns: slice) -> Tensor:
    mask = torch.zeros(height, width)
    mask[rows, columns] = torch.rand(height, width)[rows, columns]
    return mask


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(20, 61), slice(17, 40)),
        (slice(0, 70), slice(0, 53)),
        (slice(0, 1), slice(0, 1)),
        (slice(69, 70), slice(52, 53)),
        (slice(0, 70), slice(30, 31)),
        (slice(33, 36), slice(0, 53)),
        (slice(40, 70), slice(0, 9)),
    ],
    ids=["inside", "whole frame", "first pixel", "last pixel", "a column", "full width", "lower left corner"],
)
def test_value_and_gradient_agree_with_float64(rows: slice, columns: slice) -> None:
    assert_like_the_oracle(*pair(70, 53), boxed(70, 53, rows, columns))


@pytest.mark.parametrize("size", [(11, 11), (11, 12), (12, 11), (13, 64), (31, 17), (65, 33), (133, 29)])
def test_odd_sizes(size: tuple[int, int]) -> None:
    assert_like_the_oracle(*pair(*size), torch.rand(size))


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_images_do_not_cancel(level: float) -> None:
    """Variances of 1e-8 beside mean squares of 1: in float32 they would be noise."""
    image = level + 1e-4 * torch.randn(40, 40, 3)
    target = level + 1e-4 * torch.randn(40, 40, 3)
    assert_like_the_oracle(image, target, torch.ones(40, 40))


def test_values_outside_0_to_1() -> None:
    image, target = pair(30, 30)
    assert_like_the_oracle(5 * image - 2, target, torch.ones(30, 30))


def test_equal_images_are_a_minimum() -> None:
    image, _ = pair(30, 41)
    value, gradient = value_and_gradient(dssim_cpu, image, image.clone(), torch.ones(30, 41))
    assert value.item() == 0.0
    assert not gradient.any()


def test_an_empty_mask_gives_zero_and_a_zero_gradient() -> None:
    value, gradient = value_and_gradient(dssim_cpu, *pair(40, 30), torch.zeros(40, 30))
    assert value.item() == 0.0
    assert not gradient.any()


def test_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = pair(210, 71)
    mask = boxed(210, 71, slice(5, 200), slice(9, 71))
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setenv("AVATAR_THREADS", str(threads))
        results.append(value_and_gradient(dssim_cpu, image, target, mask))
    for value, gradient in results[1:]:
        assert torch.equal(value, results[0][0])
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
def test_every_instruction_set(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_SIMD", name)
    image, target = pair(45, 39)
    mask = boxed(45, 39, slice(3, 44), slice(0, 30))
    try:
        dssim_cpu(image, target, mask)
    except ValueError as error:
        pytest.skip(str(error))
    assert_like_the_oracle(image, target, mask)


def test_the_training_loss_takes_it_for_float32_and_scales_its_gradient() -> None:
    image, target = pair(40, 40)
    mask = torch.ones(40, 40)
    value, gradient = value_and_gradient(lambda *arguments: -3.0 * dssim(*arguments), image, target, mask)
    expected, expected_gradient = value_and_gradient(dssim_cpu, image, target, mask)
    assert torch.equal(value, -3.0 * expected)
    assert torch.equal(gradient, -3.0 * expected_gradient)


def test_a_target_that_is_differentiated_takes_the_plain_one() -> None:
    image, target = pair(30, 30)
    target.requires_grad_()
    dssim(image, target, torch.ones(30, 30)).backward()
    assert target.grad is not None and target.grad.any()


def test_strided_images() -> None:
    image, target = pair(40, 50)
    mask = torch.rand(50, 40)
    swapped = [tensor.transpose(0, 1) for tensor in (image, target)]
    expected = value_and_gradient(dssim_cpu, *(tensor.contiguous() for tensor in swapped), mask)
    for one, other in zip(value_and_gradient(dssim_cpu, *swapped, mask), expected, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_a_poisoned_pixel_poisons_the_loss(poison: float) -> None:
    image, target = pair(40, 40)
    image[20, 20, 1] = poison
    value, gradient = value_and_gradient(dssim_cpu, image, target, torch.ones(40, 40))
    assert value.isnan()
    assert gradient[20, 20, 1].isnan()


def test_images_smaller_than_the_window_are_refused() -> None:
    image, target = pair(10, 30)
    with pytest.raises(ValueError, match="SSIM needs images of at least 11 x 11 pixels, got 30 x 10"):
        dssim(image, target, torch.ones(10, 30))
