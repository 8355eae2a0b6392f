"""The plain-torch baseline draws what the reference draws, with its gradients: only then does its time say anything."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from avatar.bench.plain import splat_plain
from avatar.splat import splat
from avatar.splat.scenes import head_shell
from avatar.types import Camera, Gaussians

CAMERA = Camera(torch.eye(3), torch.tensor([0.01, -0.02, 0.6]), 90.0, 85.0, 22.0, 17.0, 45, 37)  # no multiple of a tile
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


@pytest.mark.parametrize("options", [{}, {"alpha_min": 2 / 255, "t_min": 1e-2}], ids=["usual", "coarse"])
@pytest.mark.parametrize("chunk", [7, 1024])
def test_image_alpha_and_gradients_are_the_references(
    options: dict[str, Any], chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avatar.bench.plain.CHUNK", chunk)
    gaussians = head_shell(400)
    found_leaves = Gaussians(*(t.clone().requires_grad_() for t in gaussians))
    true_leaves = Gaussians(*(t.double().requires_grad_() for t in gaussians))
    found = splat_plain(found_leaves, CAMERA, BACKGROUND, **options)
    true = splat(true_leaves, CAMERA, BACKGROUND.double(), backend="reference", **options)
    assert found.image.dtype == torch.float32
    assert (found.image - true.image).abs().max() <= 1e-5
    assert (found.alpha - true.alpha).abs().max() <= 1e-5
    cotangent = torch.randn(37, 45, 3, generator=torch.Generator().manual_seed(0))
    gradients = torch.autograd.grad((found.image * cotangent).sum() + found.alpha.sum(), found_leaves)
    truths = torch.autograd.grad((true.image * cotangent).sum() + true.alpha.sum(), true_leaves)
    for gradient, truth in zip(gradients, truths, strict=True):
        assert truth.norm() > 0
        assert (gradient - truth).norm() <= 1e-4 * truth.norm()


def test_without_a_visible_splat_it_shows_the_background() -> None:
    behind = Camera(torch.eye(3), torch.tensor([0.0, 0.0, -2.0]), 90.0, 90.0, 8.0, 8.0, 16, 16)
    leaves = Gaussians(*(t.requires_grad_() for t in head_shell(5)))
    image, alpha = splat_plain(leaves, behind, BACKGROUND)
    assert torch.equal(image, BACKGROUND.expand(16, 16, 3)) and not alpha.any()
