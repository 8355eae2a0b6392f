from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from heads import EXPRESSIONS, grid_head, random_params

from avatar.compute.workers import AHEAD, single_threaded_workers
from avatar.config import load_config
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.types import Camera, HeadParams

BACKGROUND = torch.tensor([0.1, 0.5, 0.9])
CAMERA = Camera(torch.eye(3), torch.tensor([0.0, 0.0, 0.5]), 120.0, 120.0, 30.0, 25.0, 61, 49)


def trained_looking(*overrides: str) -> Avatar:
    """An avatar none of whose parameters is where it starts."""
    config = load_config(["model.uv_size=24", "model.mlp_width=32", "model.mlp_layers=3", *overrides])
    avatar = make_avatar(grid_head(), torch.zeros(3), config.model)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
        avatar.opacity_logits += 2.0
        if hasattr(avatar, "mesh_points"):  # a place is in metres
            avatar.mesh_points.place *= 0.02
            avatar.mesh_points.walk()
        if hasattr(avatar, "count"):
            avatar.count.fill_(len(avatar) // 2)
            avatar.encode_points()
        if hasattr(avatar, "deformation"):  # offsets that stay in the picture, and latents near those of NDGS
            for parameter in avatar.deformation.output.parameters():
                parameter *= 0.1
    return avatar


@pytest.mark.parametrize(
    "overrides",
    [
        ("model.latent_grid=4",),
        ("model.skull_binding=true",),
        ("model.blur=1",),
        ("model.latent_grid=null",),
        ("model=flashavatar",),
        ("model=covariance",),
        ("model=ndgs",),
        ("model=splattingavatar",),
        ("model=monogaussianavatar",),
        ("model=gaussianheadavatar",),
        ("model=gaussianheadavatar_hyper",),
        ("model=gaussianheadavatar_ndgs",),
    ],
    ids=lambda overrides: overrides[0].removeprefix("model"),
)
def test_the_renderer_gives_what_the_avatar_gives(overrides: tuple[str, ...]) -> None:
    avatar = trained_looking(*overrides)
    renderer = Renderer(avatar, BACKGROUND)
    for seed in range(3):
        params = random_params(seed)
        expected, got = avatar(params, None, CAMERA.R_cam_world), renderer.gaussians(params, CAMERA)
        for name, a, b in zip(expected._fields, got, expected, strict=True):
            torch.testing.assert_close(a, b.detach(), rtol=2e-5, atol=2e-6, msg=lambda m, n=name: f"{n}: {m}")
            assert not a.requires_grad
        image = avatar.draw(expected, CAMERA, BACKGROUND).image.detach()
        assert (image - BACKGROUND).abs().max() > 0.2, "the scene is empty"
        torch.testing.assert_close(renderer.render(params, CAMERA).image, image, rtol=0, atol=2e-5)


def test_a_frame_with_few_expression_coefficients_is_padded_as_the_avatar_pads_it() -> None:
    avatar = trained_looking()
    few = random_params(expressions=2)
    zeros = torch.zeros(EXPRESSIONS - 2)
    padded = replace(few, expression=torch.cat((few.expression, zeros)))
    renderer = Renderer(avatar, BACKGROUND)
    assert torch.equal(renderer.gaussians(few).means, renderer.gaussians(padded).means)


def test_later_training_does_not_show() -> None:
    avatar = trained_looking()
    renderer, params = Renderer(avatar, BACKGROUND), random_params()
    before = renderer.gaussians(params)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter += 1.0
    for a, b in zip(renderer.gaussians(params), before, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_stream_is_the_same_frames_in_the_same_order(threads: int) -> None:
    renderer = Renderer(trained_looking(), BACKGROUND)
    frames = [(random_params(seed), CAMERA) for seed in range(23)]
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        streamed = list(renderer.stream(iter(frames)))
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert len(streamed) == len(frames)
    for rendering, frame in zip(streamed, frames, strict=True):
        torch.testing.assert_close(rendering.image, renderer.render(*frame).image, rtol=0, atol=2e-5)


def test_a_stream_takes_few_frames_ahead_and_stops_when_it_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_THREADS", "2")
    renderer, taken = Renderer(trained_looking(), BACKGROUND), 0

    def endless() -> Iterator[tuple[HeadParams, Camera]]:
        nonlocal taken
        while True:
            taken += 1
            yield random_params(taken), CAMERA

    threads = threading.active_count()
    stream = renderer.stream(endless())
    for _ in range(3):
        next(stream)
    stream.close()
    assert taken <= 3 + 2 * AHEAD
    assert threading.active_count() == threads


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_bad_frame_is_raised_when_its_turn_comes(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_THREADS", threads)
    renderer = Renderer(trained_looking(), BACKGROUND)
    bad = replace(random_params(), jaw=torch.zeros(5))
    stream = renderer.stream([(random_params(), CAMERA), (bad, CAMERA)])
    next(stream)
    with pytest.raises(ValueError, match="jaw must have shape"):
        next(stream)


def test_workers_have_one_thread_each_and_nobody_else_loses_theirs() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded_workers(2) as pool:
            assert [pool.submit(torch.get_num_threads).result() for _ in range(4)] == [1, 1, 1, 1]
            assert torch.get_num_threads() == 3
            found = []
            later = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
            later.start()
            later.join()
            assert found == [3]
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("draw", ["render", "stream"])
def test_an_avatar_whose_parameters_overflow_is_not_drawn_and_says_why(draw: str) -> None:
    avatar = trained_looking()
    with torch.no_grad():
        avatar.log_scales[7] = 100.0
    renderer = Renderer(avatar, BACKGROUND)
    with pytest.raises(
        UserError, match="scales has [123] non-finite of .*coefficients are out of range or.*trainer.learning_rates"
    ):
        if draw == "render":
            renderer.render(random_params(0), CAMERA)
        else:
            list(renderer.stream([(random_params(0), CAMERA)]))
