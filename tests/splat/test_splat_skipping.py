"""What a drawing skips does not show."""

from __future__ import annotations

import pytest
import torch
from splat.scenes import SCENES, SIMD, Scene, camera, checked_options, gradients, random_gaussians, render, use_simd

from avatar.splat import cpu
from avatar.types import Gaussians


@pytest.mark.parametrize("simd", SIMD)
# The 15,000 splats of the head take long at every pixel.
@pytest.mark.parametrize("name", [name for name in SCENES if name != "head"])
def test_skipping_does_not_change_a_bit(name: str, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    scene, drawn = SCENES[name], render(SCENES[name])
    gaussians, size = Gaussians(*(t.contiguous() for t in scene.gaussians)), (scene.camera.height, scene.camera.width)
    settings = {**cpu._settings(scene.camera, checked_options(scene, "cpu")), "everywhere": True}
    image, alpha, _ = cpu._draw(gaussians, scene.background, size, settings)
    assert torch.equal(image, drawn.image) and torch.equal(alpha, drawn.alpha)


def test_what_stands_behind_a_wall_has_no_effect_and_exactly_no_gradient() -> None:
    wall = random_gaussians(40, seed=1, spread=0.02, size=0.5)._replace(opacities=torch.full((40,), 0.9))
    behind = random_gaussians(60, seed=2, spread=0.05)
    behind = behind._replace(means=behind.means + torch.tensor([0.0, 0.0, 2.0]))
    scene = Scene(Gaussians(*(torch.cat(f) for f in zip(wall, behind, strict=True))), camera(30, 30, yaw=0.0))
    grads = gradients(scene, "cpu", torch.randn(30, 30, 3), torch.randn(30, 30))
    untouched = [all((grads[n][i] == 0).all() for n in Gaussians._fields) for i in range(100)]
    assert all(untouched[40:]) and not all(untouched[:40])
