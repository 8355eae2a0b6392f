"""The upsampler against the same operations written out, and on images without contrast."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import conv2d, instance_norm, interpolate

from avatar.gaussianheadavatar.upsampler import Upsampler


def test_parameters_are_counted_as_published() -> None:
    with torch.device("meta"):
        upsampler = Upsampler()
    assert sum(p.numel() for p in upsampler.parameters()) == 322_659


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_the_image_is_that_of_the_plain_operations(factor: int) -> None:
    upsampler, image = Upsampler(4, factor).double(), torch.randn(6, 5, 4, dtype=torch.float64)
    x = image.permute(2, 0, 1)[None].contiguous()
    weights = [weight for name, weight in upsampler.named_parameters() if name.startswith("stages")]
    sizes = [(16, 4), (16, 16), (8, 16), (8, 8), (4, 8), (4, 4)][: 2 * factor.bit_length()]
    assert [tuple(weight.shape[:2]) for weight in weights] == sizes
    for i, weight in enumerate(weights):
        if i > 0 and i % 2 == 0:
            x = interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = torch.relu(instance_norm(conv2d(x, weight.contiguous(), padding=1)))
    expected = torch.sigmoid(conv2d(x, upsampler.colour.weight, upsampler.colour.bias))[0].permute(1, 2, 0)
    found = upsampler(image)
    assert found.shape == (factor * 6, factor * 5, 3) and found.is_contiguous()
    torch.testing.assert_close(found, expected)


def test_gradients_of_the_image() -> None:
    upsampler = Upsampler(2, 2).double()
    image = torch.randn(3, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(upsampler, (image,))


@pytest.mark.parametrize("value", [0.0, 1.0, 1e4])
def test_an_image_without_contrast_gives_finite_colours_and_gradients(value: float) -> None:
    upsampler, image = Upsampler(4, 4), torch.full((16, 16, 4), value, requires_grad=True)
    colours = upsampler(image)
    colours.sum().backward()
    assert bool(((colours >= 0) & (colours <= 1)).all())
    assert image.grad is not None and bool(image.grad.isfinite().all())
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in upsampler.parameters())
