"""The way in which the kernels cut their work on a GPU, which other tests widen for the interpreter."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat import test_splat_features
from splat.scenes import SCENES, Scene, assert_agrees, camera, random_gaussians

from avatar.compute.device import interpreted


@pytest.mark.parametrize("name", ["small", "opaque"])
def test_a_scene_agrees_with_the_reference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from avatar.splat import gpu_draw

    monkeypatch.setattr(gpu_draw, "TUNING", gpu_draw.Tuning())
    g = random_gaussians(60, seed=8)
    scene = Scene(g if name == "small" else g._replace(opacities=torch.ones(60)), camera(19, 21))
    assert_agrees(scene, "gpu")


@pytest.mark.parametrize("channels", [3, 33] if interpreted() else [1, 3, 8, 32, 33])
def test_features_of_64_x_48_pixels_agree_with_the_reference(channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from avatar.splat import gpu_draw

    monkeypatch.setattr(gpu_draw, "TUNING", gpu_draw.Tuning())
    test_splat_features.assert_agrees("opaque", channels, "gpu")


# A GPU's compilers would take minutes for the wide steps that are quick in the interpreter.
BASE = {"tile": 16, "step": 32, "backward_step": 32} if interpreted() else {}
TILES = [{"tile": 8}, {"tile": 32, "step": 16}] if interpreted() else [{"tile": 16, "step": 4}]


@pytest.mark.parametrize(
    "change",
    [
        *TILES,
        {"step": 4, "backward_step": 8},
        {"lanes": 64, "backward_lanes": 128},
        {"summed": 4, "summed_lanes": 8},
    ],
    ids=str,
)
def test_any_other_way_agrees_too(change: dict[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    from avatar.splat import gpu_draw

    monkeypatch.setattr(gpu_draw, "TUNING", replace(gpu_draw.Tuning(**BASE), **change))
    assert_agrees(SCENES["17x33"], "gpu")
