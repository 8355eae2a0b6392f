"""What a drawing counts, and that what it skips does not show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from splat.scenes import SCENES, SIMD, Scene, camera, gradients, random_gaussians, render, single_splat, use_simd

import avatar.splat
from avatar.splat import Counters, counters
from avatar.splat.cpu import count_cpu
from avatar.types import Gaussians, Rendering

TILE = 32


def _count(scene: Scene, backend: str = "cpu") -> Counters:
    return counters(scene.gaussians, scene.camera, scene.background, backend=backend, **scene.options)


def _drawn_and_counted(scene: Scene, *, everywhere: bool) -> tuple[Rendering, Counters]:
    options: dict[str, Any] = {**(avatar.splat.splat.__kwdefaults__ or {}), **scene.options, "backend": "cpu"}
    checked = avatar.splat._checked_options(scene.gaussians, scene.camera, scene.background, **options)
    return count_cpu(scene.gaussians, scene.camera, scene.background, **checked, everywhere=everywhere)


@pytest.mark.parametrize("simd", SIMD)
# The 15,000 splats of the head take long at every pixel.
@pytest.mark.parametrize("name", [name for name in SCENES if name != "head"])
def test_skipping_does_not_change_a_bit(name: str, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    drawn = render(SCENES[name])
    skipping, some = _drawn_and_counted(SCENES[name], everywhere=False)
    everywhere, most = _drawn_and_counted(SCENES[name], everywhere=True)
    for rendering in (skipping, everywhere):
        assert torch.equal(rendering.image, drawn.image) and torch.equal(rendering.alpha, drawn.alpha)
    assert some.pixels_composited == most.pixels_composited
    assert some.pixels_evaluated <= most.pixels_evaluated
    assert most.hidden_outside == 0 and most.pairs == most.visible * most.tiles


@pytest.mark.parametrize("name", ["random", "thresholds", "opaque", "wide field of view"])
def test_the_numbers_add_up(name: str) -> None:
    scene = SCENES[name]
    found = _count(scene)
    assert found.splats == len(scene.gaussians.means)
    assert found.pixels_composited <= found.pixels_evaluated
    assert found.visible_without_effect <= found.visible
    assert found.pairs_processed <= found.pairs <= found.pairs_in_boxes
    assert found.tiles == -(-scene.camera.width // TILE) * -(-scene.camera.height // TILE)
    assert found.blocks_stopped <= found.blocks and found.tiles_stopped <= found.tiles


def test_every_reason_to_hide_a_splat_is_counted() -> None:
    g = random_gaussians(10, spread=0.01, size=0.01)
    means, opacities, scales = g.means.clone(), torch.full((10,), 0.5), g.scales.clone()
    opacities[0] = 0.0039  # just below 1/255
    means[1:3, 2] = -5.0
    means[3:6, 0] = 30.0
    scales[6] = 0.0
    scene = Scene(g._replace(means=means, opacities=opacities, scales=scales), camera(40, 40, yaw=0.0))
    found = _count(scene.with_options(blur=0.0))
    hidden = found.hidden_transparent, found.hidden_near, found.hidden_flat, found.hidden_outside
    assert hidden == (1, 2, 1, 3) and found.visible == 3


def test_one_splat_in_one_tile_and_what_the_other_ways_to_bin_it_would_take() -> None:
    scene = single_splat(opacity=0.5, scale=0.02)  # standard deviation 2 pixels in the middle of 33 x 33
    found = _count(scene)
    drawn = int((render(scene).alpha > 0).sum())
    assert found.pixels_composited == drawn
    assert (found.tiles, found.visible, found.visible_without_effect, found.tiles_stopped) == (4, 1, 0, 0)
    assert (found.pairs, found.pairs_in_boxes, found.pairs_in_squares) == (1, 1, 1)

    # 40 pixels right of the first tile's middle a needle at 45 degrees leaves the box's other corners alone.
    needle = scene.gaussians._replace(
        scales=torch.tensor([[0.3, 0.001, 0.001]]), quats=torch.tensor([[0.92388, 0.0, 0.0, 0.38268]])
    )
    view = replace(scene.camera, width=96, height=96, cx=48.0, cy=48.0)
    found = _count(replace(scene, gaussians=needle, camera=view))
    assert found.tiles == 9 and 3 <= found.pairs < 9
    assert (found.pairs_in_boxes, found.pairs_in_squares) == (9, 9)


def test_what_stands_behind_a_wall_has_no_effect_and_exactly_no_gradient() -> None:
    wall = random_gaussians(40, seed=1, spread=0.02, size=0.5)._replace(opacities=torch.full((40,), 0.9))
    behind = random_gaussians(60, seed=2, spread=0.05)
    behind = behind._replace(means=behind.means + torch.tensor([0.0, 0.0, 2.0]))
    scene = Scene(Gaussians(*(torch.cat(f) for f in zip(wall, behind, strict=True))), camera(30, 30, yaw=0.0))
    found = _count(scene)
    assert found.tiles_stopped == found.tiles == 1 and found.blocks_stopped == found.blocks
    assert found.pairs_processed <= 40 and found.visible_without_effect >= found.visible - 40 > 0
    grads = gradients(scene, "cpu", torch.randn(30, 30, 3), torch.randn(30, 30))
    untouched = sum(all((grads[n][i] == 0).all() for n in Gaussians._fields) for i in range(100))
    assert untouched == found.visible_without_effect + found.splats - found.visible


def test_a_region_counts_what_is_in_it() -> None:
    scene = SCENES["random"]
    whole, part = _count(scene), _count(scene.with_options(region=(slice(40, 60), slice(70, 90))))
    assert part.tiles == 1 and part.splats == whole.splats
    assert part.hidden_outside > whole.hidden_outside and part.pixels_composited < whole.pixels_composited / 10


def test_counters_check_like_the_drawing() -> None:
    scene = SCENES["1x1"]
    with pytest.raises(ValueError, match="alpha_min must be in"):
        _count(scene.with_options(alpha_min=2.0))
    with pytest.raises(TypeError, match="tmin"):
        _count(scene.with_options(tmin=0.1))
