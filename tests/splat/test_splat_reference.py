"""The torch reference: its derivatives against finite differences, and that its blocks do not matter."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from splat.scenes import Scene, camera, in_float64, random_gaussians, render

from avatar.splat.reference import splat_reference
from avatar.types import Gaussians

OPTIONS: dict[str, Any] = {
    "alpha_min": 0.0,
    "alpha_max": 0.999,
    "t_min": 0.0,
    "blur": 0.3,
    "near": 0.01,
    "antialiased": False,
}


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gradcheck(sh_degree: int, antialiased: bool) -> None:
    scene = in_float64(Scene(random_gaussians(4, sh_degree=sh_degree, spread=0.1, size=0.1), camera(4, 3)))

    def draw(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        options = {**OPTIONS, "antialiased": antialiased}
        return tuple(splat_reference(Gaussians(*inputs[:5]), scene.camera, inputs[5], sh_degree=sh_degree, **options))

    inputs = [t.clone().requires_grad_() for t in (*scene.gaussians, scene.background)]
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_gradcheck_where_the_jacobian_is_clamped() -> None:
    g = random_gaussians(4, sh_degree=0, spread=0.05, size=0.3)
    g = g._replace(means=g.means + torch.tensor([[1.4, 0.0, 0.0], [-1.4, 0.0, 0.0], [0.0, 1.4, 0.0], [0.0, -1.4, 0.0]]))
    scene = in_float64(Scene(g, camera(6, 6, yaw=0.0)))

    def draw(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(splat_reference(Gaussians(*inputs), scene.camera, scene.background, sh_degree=0, **OPTIONS))

    assert draw(*scene.gaussians)[1].max() > 0.05  # they reach into the image
    assert torch.autograd.gradcheck(draw, [t.clone().requires_grad_() for t in scene.gaussians], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("block", [5, 32, 1000])
def test_result_does_not_depend_on_the_block(block: int) -> None:
    scene = in_float64(Scene(random_gaussians(200), camera(50, 41)))
    expected = render(scene, "reference")
    cut_offs = torch.tensor([1 / 255, 0.999, 1e-4], dtype=torch.float32).tolist()
    options = {**OPTIONS, **dict(zip(("alpha_min", "alpha_max", "t_min"), cut_offs, strict=True))}
    found = splat_reference(scene.gaussians, scene.camera, scene.background, sh_degree=3, block=block, **options)
    assert (found.image - expected.image).abs().max() < 1e-13
    assert (found.alpha - expected.alpha).abs().max() < 1e-13


def test_chunks_of_splats_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = in_float64(Scene(random_gaussians(200)._replace(opacities=torch.ones(200)), camera(40, 40)))
    expected = render(scene, "reference")
    monkeypatch.setattr("avatar.splat.reference.MAX_EVALUATIONS", 16 * 16 * 3)
    found = render(scene, "reference")
    assert (found.image - expected.image).abs().max() < 1e-13


def test_float32_is_computed_in_float64() -> None:
    scene = Scene(random_gaussians(100), camera(40, 40))
    found, expected = render(scene, "reference"), render(in_float64(scene), "reference")
    assert found.image.dtype == torch.float32
    assert torch.equal(found.image, expected.image.float())
