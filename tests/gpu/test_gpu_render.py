"""A trained avatar's pictures on the GPU's path."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import grid_head, random_params
from interpreter import DEVICE, error, the_cpus_way

from avatar.config import load_config
from avatar.gaussians.base_model import Avatar
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.splat.scenes import head_camera
from avatar.types import Gaussians

RECIPES = ("model=hypergaussians", "experiment=paper", "model=flashavatar")


def avatar_of(recipe: str) -> Avatar:
    config = load_config([recipe, "model.uv_size=18", "model.mlp_width=16", "model.initial_opacity=0.6"])
    torch.manual_seed(0)
    avatar = make_avatar(grid_head(), torch.zeros(3), config.model)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return avatar


@pytest.mark.parametrize("recipe", RECIPES)
def test_gaussians_and_picture_are_those_of_the_cpu(recipe: str) -> None:
    params, camera, background = random_params(), head_camera(32), torch.tensor([0.2, 0.5, 0.9])
    avatar = avatar_of(recipe)
    with the_cpus_way(), torch.no_grad():
        expected = avatar(params)
        picture = avatar.draw(expected, camera, background)
    renderer = Renderer(avatar.to(DEVICE), background)
    found, drawn = renderer.gaussians(params), renderer.render(params, camera)
    for name, own, wanted in zip(Gaussians._fields, found, expected, strict=True):
        assert error(own, wanted) < 1e-5, name
    assert (drawn.image.cpu() - picture.image).abs().mean() < 1e-5  # single pixels may be at a cut-off
    with torch.no_grad():
        assert error(avatar(params).means, expected.means) < 1e-5


def test_a_stream_gives_the_pictures_in_order_on_the_cpu() -> None:
    renderer = Renderer(avatar_of("model=hypergaussians").to(DEVICE), torch.ones(3))
    frames = [(random_params(seed), head_camera(20)) for seed in range(5)]
    found = list(renderer.stream(frames))
    assert len(found) == 5
    for rendering, frame in zip(found, frames, strict=True):
        assert rendering.image.is_cpu and torch.equal(rendering.image, renderer.render(*frame).image.cpu())


def test_fewer_coefficients_than_the_head_has_stand_for_zeros() -> None:
    renderer = Renderer(avatar_of("model=hypergaussians").to(DEVICE), torch.ones(3))
    params = random_params()
    filled = replace(params, expression=torch.cat((params.expression[:2], torch.zeros(3))))
    short = replace(params, expression=params.expression[:2])
    assert error(renderer.gaussians(short).means, renderer.gaussians(filled).means.cpu()) < 1e-6


def test_later_training_does_not_show() -> None:
    avatar = avatar_of("model=hypergaussians").to(DEVICE)
    renderer = Renderer(avatar, torch.ones(3))
    before = renderer.gaussians(random_params())
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.zero_()
    assert all(torch.equal(a, b) for a, b in zip(renderer.gaussians(random_params()), before, strict=True))
