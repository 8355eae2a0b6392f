"""Huber and D-SSIM: the kernels against the CPU's."""

from __future__ import annotations

import pytest
import torch
from interpreter import DEVICE, error, the_cpus_way
from torch import Tensor

from avatar.losses.photometric import dssim, photometric_loss

HEIGHT, WIDTH = 41, 37


def images(kind: str) -> tuple[Tensor, Tensor, Tensor]:
    """Image, target and a mask that is 0 at the border, with parts between 0 and 1."""
    g = torch.Generator().manual_seed(0)
    target = torch.rand(HEIGHT, WIDTH, 3, generator=g)
    noise = torch.randn(HEIGHT, WIDTH, 3, generator=g)
    image = {"near": target + 0.05 * noise, "far": target + noise, "bright": 1 + 1e-3 * noise, "same": target.clone()}[
        kind
    ]
    mask = torch.zeros(HEIGHT, WIDTH)
    mask[6:30, 9:33] = torch.rand(24, 24, generator=g)
    return image, (torch.ones_like(target) if kind == "bright" else target), mask


@pytest.mark.parametrize("kind", ["near", "far", "bright", "same"])
def test_dssim_and_its_gradient(kind: str) -> None:
    image, target, mask = images(kind)
    leaf = image.clone().requires_grad_()
    with the_cpus_way():
        expected = dssim(leaf, target, mask)
        (expected_gradient,) = torch.autograd.grad(expected, leaf)
    moved = image.to(DEVICE).requires_grad_()
    found = dssim(moved, target.to(DEVICE), mask.to(DEVICE))
    (gradient,) = torch.autograd.grad(2.0 * found, moved)
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-5, abs=1e-9)
    # Float32 against the CPU's double precision: where all is bright the variances are small beside the squares.
    tolerance = 1e-3 if kind == "bright" else 1e-5
    if kind == "same":
        assert (gradient == 0).all()
    else:
        assert error(gradient, 2 * expected_gradient) < tolerance


@pytest.mark.parametrize("kind", ["near", "far", "same"])
def test_both_huber_losses_and_their_gradients(kind: str) -> None:
    image, target, mask = images(kind)
    leaf = image.clone().requires_grad_()
    with the_cpus_way():
        expected = photometric_loss(leaf, target, mask, mask, mouth_weight=7.0, delta=0.2)
        (expected_gradient,) = torch.autograd.grad(1.5 * expected.frame - 0.5 * expected.mouth, leaf)
    moved = image.to(DEVICE).requires_grad_()
    others = target.to(DEVICE), mask.to(DEVICE), mask.to(DEVICE)
    found = photometric_loss(moved, *others, mouth_weight=7.0, delta=0.2)
    (gradient,) = torch.autograd.grad(1.5 * found.frame - 0.5 * found.mouth, moved)
    for name in ("total", "frame", "mouth"):
        wanted = float(getattr(expected, name).detach())
        assert float(getattr(found, name).detach()) == pytest.approx(wanted, rel=1e-6, abs=1e-12)
    assert kind == "same" or error(gradient, expected_gradient) < 1e-6


def test_one_of_the_losses_alone_has_its_own_gradient() -> None:
    image, target, mask = images("near")
    gradients = {}
    for name in ("frame", "mouth"):
        leaf = image.to(DEVICE).requires_grad_()
        loss = photometric_loss(leaf, target.to(DEVICE), mask.to(DEVICE), mask.to(DEVICE))
        (gradients[name],) = torch.autograd.grad(getattr(loss, name), leaf)
    assert (gradients["mouth"][mask == 0] == 0).all() and (gradients["mouth"][mask > 0] != 0).any()
    assert (gradients["frame"] != 0).all()


def test_a_target_that_is_differentiated_takes_torchs_own_operators() -> None:
    image, target, mask = images("near")
    leaf = target.to(DEVICE).requires_grad_()
    (gradient,) = torch.autograd.grad(dssim(image.to(DEVICE), leaf, mask.to(DEVICE)), leaf)
    assert gradient.norm() > 0
