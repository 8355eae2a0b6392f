"""A trained avatar's pictures on the GPU's path."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import grid_head, random_params
from interpreter import DEVICE, as_on_a_gpu, error, the_cpus_way

from avatar import render as render_module
from avatar.compute.cuda_graph import Replay
from avatar.config import load_config
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.splat import checked_drawings
from avatar.splat.scenes import head_camera
from avatar.types import Camera, Gaussians, HeadParams

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


def moving(size: int = 24, frames: int = 5) -> list[tuple[HeadParams, Camera]]:
    """Different expressions before a camera that turns."""
    camera = head_camera(size)
    turns = [torch.linalg.qr(torch.eye(3) + 0.02 * i * torch.ones(3, 3).triu(1))[0] for i in range(frames)]
    turns = [turn * turn.diagonal().sign() for turn in turns]
    cameras = [replace(camera, R_cam_world=turn @ camera.R_cam_world) for turn in turns]
    return [(random_params(seed), seen) for seed, seen in enumerate(cameras)]


@pytest.mark.parametrize("other", [None, torch.linalg.qr(torch.eye(3) + 0.1 * torch.ones(3, 3).triu(1))[0]])
def test_replayed_frames_have_the_bits_of_launched_ones(
    other: torch.Tensor | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [(params, replace(camera, R_ref_cam=other)) for params, camera in moving()]
    avatar = avatar_of("model.head_rotation=true").to(DEVICE)
    avatar.learn_head_rotation(torch.stack([camera.head_rotation for _, camera in frames]))
    monkeypatch.setattr(render_module, "WARM", 99)
    launching = Renderer(avatar, torch.ones(3))
    expected = [launching.render(*frame) for frame in frames]
    monkeypatch.setattr(render_module, "WARM", 1)
    replaying = Renderer(avatar, torch.ones(3))
    starts = count_starts(monkeypatch)
    found = [replaying.render(*frame) for frame in frames]
    assert starts == [1] * (len(frames) - 1)
    for own, wanted in zip(found, expected, strict=True):
        assert torch.equal(own.image, wanted.image) and torch.equal(own.alpha, wanted.alpha)
    assert not torch.equal(found[1].image, found[2].image)


def count_starts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    starts: list[int] = []

    class Counted(Replay):
        def __call__(self, inputs):  # type: ignore[no-untyped-def]
            starts.append(1)
            return super().__call__(inputs)

    monkeypatch.setattr(render_module, "Replay", Counted)
    return starts


def test_other_intrinsics_are_another_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_module, "WARM", 1)
    monkeypatch.setattr(render_module, "KEPT", 2)
    renderer = Renderer(avatar_of("model=hypergaussians").to(DEVICE), torch.ones(3))
    params, camera = random_params(), head_camera(20)
    zoomed = [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for zoom in (1.0, 1.2, 1.4)]
    expected = [renderer.render(params, seen).image for seen in zoomed]
    for _ in range(2):
        for seen, wanted in zip(zoomed, expected, strict=True):
            assert torch.equal(renderer.render(params, seen).image, wanted)
    assert not torch.equal(expected[0], expected[1])


def test_a_replayed_frame_that_cannot_be_drawn_raises_where_it_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_module, "WARM", 1)
    renderer = Renderer(avatar_of("model=hypergaussians").to(DEVICE), torch.ones(3))
    params, camera = random_params(), head_camera(20)
    bad = replace(params, expression=params.expression * float("inf"))
    with as_on_a_gpu():
        good = [renderer.render(params, camera) for _ in range(3)]
        assert renderer.render(bad, camera).alpha.isnan().any()
        with checked_drawings(), pytest.raises(UserError, match="cannot be drawn"):
            renderer.render(bad, camera)
        assert torch.equal(renderer.render(params, camera).image, good[0].image)
