"""The way in which the kernels cut their work on a GPU, which other tests widen for the interpreter."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat.scenes import SCENES, Scene, assert_agrees, camera, random_gaussians


@pytest.mark.parametrize("name", ["small", "opaque"])
def test_a_scene_agrees_with_the_reference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from avatar.splat import gpu_draw

    monkeypatch.setattr(gpu_draw, "TUNING", gpu_draw.Tuning())
    g = random_gaussians(60, seed=8)
    scene = Scene(g if name == "small" else g._replace(opacities=torch.ones(60)), camera(19, 21))
    assert_agrees(scene, "gpu")


@pytest.mark.parametrize(
    "change",
    [
        {"tile": 8},
        {"tile": 32, "step": 16},
        {"step": 4, "backward_step": 8},
        {"lanes": 64, "backward_lanes": 128},
        {"summed": 1, "summed_lanes": 32},
    ],
    ids=str,
)
def test_any_other_way_agrees_too(change: dict[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    from avatar.splat import gpu_draw

    monkeypatch.setattr(gpu_draw, "TUNING", replace(gpu_draw.Tuning(16, 32, 32), **change))
    assert_agrees(SCENES["17x33"], "gpu")
