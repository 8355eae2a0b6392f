"""The torch reference: its derivatives against finite differences, and that its blocks do not matter."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from splat.scenes import Scene, camera, in_float64, inputs_of, random_gaussians, render, with_inputs

from avatar.splat.options import Options, check_region
from avatar.splat.reference import splat_reference

OPTIONS: dict[str, Any] = {
    "alpha_min": 0.0,
    "alpha_max": 0.999,
    "t_min": 0.0,
    "blur": 0.3,
    "near": 0.01,
    "antialiased": False,
}


def options_of(scene: Scene, **options: Any) -> Options:
    whole = check_region(None, scene.camera.width, scene.camera.height)
    return Options(**{**OPTIONS, "region": whole, **options})


def check_gradients(scene: Scene, block: int = 16, **options: Any) -> None:
    """In all that a drawing has a gradient in, against finite differences."""
    inputs = inputs_of(in_float64(scene))

    def draw(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moved = with_inputs(scene, dict(zip(inputs, values, strict=True)))
        return tuple(
            splat_reference(moved.gaussians, moved.camera, moved.background, options_of(scene, **options), block)
        )

    leaves = [tensor.clone().requires_grad_() for tensor in inputs.values()]
    assert torch.autograd.gradcheck(draw, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("sh_degree", "antialiased"),
    [(0, False), (0, True), (3, True), pytest.param(3, False, marks=pytest.mark.slow)],
)
def test_gradcheck(sh_degree: int, antialiased: bool) -> None:
    g = random_gaussians(5, sh_degree=sh_degree, spread=0.1, size=0.1)
    g.means[4, 2] -= 2.0  # behind the camera
    check_gradients(Scene(g, camera(4, 3, centre=(0.3, 0.8))), sh_degree=sh_degree, antialiased=antialiased)


def test_gradcheck_where_the_jacobian_is_clamped() -> None:
    g = random_gaussians(4, sh_degree=0, spread=0.05, size=0.3)
    g = g._replace(means=g.means + torch.tensor([[1.4, 0.0, 0.0], [-1.4, 0.0, 0.0], [0.0, 1.4, 0.0], [0.0, -1.4, 0.0]]))
    scene = Scene(g, camera(6, 6, yaw=0.0))
    assert render(scene.with_options(alpha_min=0.0)).alpha.max() > 0.05  # they reach into the image
    check_gradients(scene, sh_degree=0)


@pytest.mark.parametrize("block", [5, 32, 1000])
def test_result_does_not_depend_on_the_block(block: int) -> None:
    scene = in_float64(Scene(random_gaussians(200), camera(50, 41)))
    expected = render(scene, "reference")
    cut_offs = torch.tensor([1 / 255, 0.999, 1e-4], dtype=torch.float32).tolist()
    options = options_of(scene, sh_degree=3, **dict(zip(("alpha_min", "alpha_max", "t_min"), cut_offs, strict=True)))
    found = splat_reference(scene.gaussians, scene.camera, scene.background, options, block)
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
