"""Drawings of features for the tests of the splatter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from splat.scenes import POSE, Scene
from torch import Tensor

from avatar.compute.device import interpreted
from avatar.splat import splat_features
from avatar.types import FeatureGaussians, Rendering

FIELDS = (*FeatureGaussians._fields, "background")


def with_features(scene: Scene, channels: int, *, positive: bool = False) -> dict[str, Tensor]:
    """All inputs of a drawing with random features, of both signs unless `positive`."""
    g = torch.Generator().manual_seed(channels)
    means, quats, scales, opacities, _ = scene.gaussians
    features, background = torch.randn(len(means), channels, generator=g), torch.randn(channels, generator=g)
    if positive:
        features, background = features.abs() + 0.1, background.abs()
    pose = {name: getattr(scene.camera, name) for name in POSE}
    inputs = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    return {**inputs, "background": background, **pose}


def draw(scene: Scene, inputs: dict[str, Tensor], backend: Any) -> Rendering:
    """A GPU's drawing of tensors on the CPU comes back to it."""
    moved = backend == "gpu" and not interpreted()
    tensors = [inputs[name].cuda() if moved else inputs[name] for name in FIELDS]
    view = replace(scene.camera, **{name: inputs[name] for name in POSE})
    options = {name: value for name, value in scene.options.items() if name != "sh_degree"}
    drawn = splat_features(*tensors[:5], view, tensors[5], backend=backend, **options)
    return Rendering(*(tensor.cpu() for tensor in drawn)) if moved else drawn


def cotangents(scene: Scene, channels: int) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(7)
    size = scene.camera.height, scene.camera.width
    return torch.randn(*size, channels, generator=g), torch.randn(size, generator=g)


def everything(
    scene: Scene, inputs: dict[str, Tensor], backend: Any, by_image: Tensor | None, by_alpha: Tensor | None
) -> tuple[Rendering, dict[str, Tensor]]:
    """The drawing, and the gradients in all inputs."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    drawn = draw(scene, leaves, backend)
    pairs = [(o, g.to(o)) for o, g in zip(drawn, (by_image, by_alpha), strict=True) if g is not None]
    outputs, by_outputs = zip(*pairs, strict=True)
    found = torch.autograd.grad(outputs, list(leaves.values()), by_outputs, allow_unused=True)
    by_name = {n: torch.zeros_like(leaves[n]) if g is None else g for n, g in zip(leaves, found, strict=True)}
    return Rendering(*(tensor.detach() for tensor in drawn)), by_name
