"""The head's rotation before its camera as an input of the network, and which models have it."""

from __future__ import annotations

import math

import pytest
import torch
from heads import grid_head, random_params
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from avatar.config import load_config
from avatar.gaussians.base_model import Avatar
from avatar.gaussians.head_rotation import LIMIT, VALUES, head_rotation_input, learned_turning
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.types import Camera

SMALL = ["model.uv_size=24", "model.mlp_width=16", "model.mlp_layers=2"]


def rotations(vectors: Tensor, mean: Tensor) -> Tensor:
    return mean @ axis_angle_to_rotation_matrix(vectors)


def a_mean() -> Tensor:
    return axis_angle_to_rotation_matrix(torch.tensor([[math.pi - 0.2, 0.3, 0.1]]))[0]


def turns() -> Tensor:
    """Fifty small ones, with their opposites, so that their mean is none."""
    some = torch.randn(50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([0.02, 0.12, 0.03])
    return torch.cat((some, -some))


def small_avatar(with_input: bool = True, **options: object) -> Avatar:
    extra = [f"{key}={value}" for key, value in options.items()]
    torch.manual_seed(2)
    avatar = make_avatar(
        grid_head(),
        torch.zeros(3),
        load_config([*SMALL, f"model.head_rotation={str(with_input).lower()}", *extra]).model,
    )
    assert avatar.hyper is not None
    with torch.no_grad():
        for parameter in avatar.hyper.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return avatar


def camera(rotation: Tensor) -> Camera:
    return Camera(rotation, torch.tensor([0.0, 0.0, 1.0]), 80.0, 80.0, 16.0, 16.0, 32, 32)


def test_it_is_the_sines_of_the_turn_in_units_of_their_spread() -> None:
    vectors, mean = turns(), a_mean()
    R = rotations(vectors, mean)
    turning = learned_turning(R)
    inputs = torch.stack([head_rotation_input(turning, r) for r in R])
    angle = vectors.norm(dim=1, keepdim=True)
    sines = vectors / angle * angle.sin()
    expected = sines / sines.square().mean().sqrt()
    torch.testing.assert_close(inputs, expected.clamp(-LIMIT, LIMIT), rtol=0, atol=1e-4)
    assert (inputs.abs() == LIMIT).any(), "some are turned farther than the limit"
    torch.testing.assert_close(head_rotation_input(turning, mean), torch.zeros(3), rtol=0, atol=1e-5)


def test_a_head_that_never_turns_has_input_zero() -> None:
    turning = learned_turning(a_mean().repeat(10, 1, 1))
    assert (turning == 0).all() and (head_rotation_input(turning, a_mean()) == 0).all()


def test_the_network_hears_it_and_the_mesh_does_not() -> None:
    avatar, params = small_avatar(), random_params()
    avatar.learn_head_rotation(rotations(turns(), a_mean()))
    side = rotations(torch.tensor([[0.0, 0.1, 0.0]]), a_mean())[0]
    unturned, turned, unknown = avatar(params, None, a_mean()), avatar(params, None, side), avatar(params)
    torch.testing.assert_close(unknown.means, unturned.means, rtol=0, atol=1e-6)
    assert (turned.means - unturned.means).norm(dim=1).max() > 1e-5
    assert avatar.condition(params, side).shape == avatar.condition(params).shape
    assert len(avatar.condition(params)) == len(params.condition()) + VALUES


def test_without_it_the_camera_makes_no_difference() -> None:
    avatar, params = small_avatar(with_input=False), random_params()
    avatar.learn_head_rotation(rotations(turns(), a_mean()))
    side = rotations(torch.tensor([[0.0, 0.1, 0.0]]), a_mean())[0]
    assert avatar.turning is None and not any("turning" in name for name in avatar.state_dict())
    assert all((a == b).all() for a, b in zip(avatar(params, None, side), avatar(params), strict=True))


@pytest.mark.parametrize("model", ["flashavatar", "monogaussianavatar", "ndgs"])
def test_other_networks_can_be_told_too(model: str) -> None:
    avatar = make_avatar(
        grid_head(), torch.zeros(3), load_config([*SMALL, f"model={model}", "model.head_rotation=true"]).model
    )
    avatar.learn_head_rotation(rotations(turns(), a_mean()))
    assert avatar.turning is not None and (avatar.turning != 0).any()
    avatar(random_params(), None, a_mean())


def test_where_there_is_no_network_nobody_is_told() -> None:
    avatar = make_avatar(grid_head(), torch.zeros(3), load_config([*SMALL, "model=splattingavatar"]).model)
    assert avatar.turning is None


def test_the_renderer_tells_it_what_the_camera_sees() -> None:
    avatar, params = small_avatar(), random_params()
    avatar.learn_head_rotation(rotations(turns(), a_mean()))
    background = torch.ones(3)
    renderer = Renderer(avatar, background)
    for vector in ([0.0, 0.1, 0.0], [0.03, -0.2, 0.0]):
        seen = camera(rotations(torch.tensor([vector]), a_mean())[0])
        expected = avatar.draw(avatar(params, None, seen.R_cam_world), seen, background).image
        torch.testing.assert_close(renderer.render(params, seen).image, expected, rtol=0, atol=1e-4)


def test_an_avatar_is_drawn_with_its_own_blur() -> None:
    avatar, seen, background = small_avatar(**{"model.blur": 2.0}), camera(a_mean()), torch.ones(3)
    gaussians = avatar(random_params())
    drawn = avatar.draw(gaussians, seen, background).image
    assert (drawn != avatar.draw(gaussians, seen, background, blur=0.05).image).any()
    assert (drawn == Renderer(avatar, background).draw(gaussians, seen, background).image).all()
    assert (drawn == avatar.draw(gaussians, seen, background, blur=2.0).image).all()


def test_a_camera_on_the_cpu_needs_nothing_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """On torch's meta device, where nothing can be read back, the input is computed beside the camera."""
    import avatar.gaussians.base_model

    R = rotations(turns(), a_mean())
    avatar_there = small_avatar()
    avatar_there.learn_head_rotation(R)
    expected = head_rotation_input(torch.as_tensor(avatar_there.turning), R[3])
    inputs: list[Tensor] = []

    def recorded(turning: Tensor, rotation: Tensor) -> Tensor:
        inputs.append(head_rotation_input(turning, rotation))
        return inputs[-1]

    monkeypatch.setattr(avatar.gaussians.base_model, "head_rotation_input", recorded)
    avatar_there.to("meta")
    condition = avatar_there.condition(random_params(), R[3])
    assert condition.is_meta and inputs[0].is_cpu
    torch.testing.assert_close(inputs[0], expected, rtol=0, atol=0)
