"""Gaussian Head Avatar as a model: what moves its Gaussians, how they are drawn, and where they start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from heads import grid_head, random_params, rest_params
from poison import poisoned
from small_runs import new_avatar, open_small, small_config

from avatar.errors import UserError
from avatar.gaussianheadavatar import model
from avatar.gaussianheadavatar.model import FIT_STEPS, GaussianHeadAvatar, small_camera
from avatar.head.model import matrix_from_6d
from avatar.runs.model_registry import make_avatar
from avatar.splat import splat_features
from avatar.train.trainer import initialize_from_frames
from avatar.types import Camera

NAMES = ["gaussianheadavatar", "gaussianheadavatar_hyper", "gaussianheadavatar_ndgs"]
CAMERA = Camera(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0, 1]), 150, 150, 27, 20, 51, 43)
WHITE = torch.ones(3)


def lively(name: str, *overrides: str) -> GaussianHeadAvatar:
    """An avatar none of whose parameters is as at the start."""
    torch.manual_seed(1)
    avatar = make_avatar(grid_head(), torch.zeros(3), small_config(f"model={name}", *overrides).model)
    assert isinstance(avatar, GaussianHeadAvatar)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter += 0.05 * torch.randn(parameter.shape)
        avatar.positions *= 2.0
        avatar.log_scales -= 4.0
    return avatar


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_has_a_gradient(name: str) -> None:
    avatar = lively(name)
    images = avatar.training_images(avatar(random_params(), None, torch.eye(3)), CAMERA, WHITE, 0)
    sum((image * torch.rand(image.shape)).sum() for image in images).backward()
    missing = [n for n, p in avatar.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert not missing


@pytest.mark.parametrize("name", NAMES)
def test_the_expression_moves_what_is_near_the_face_alone(name: str) -> None:
    avatar = lively(name)
    with torch.no_grad():
        avatar.positions[: len(avatar) // 2] = avatar.centre + avatar.unit * avatar.places[:1]
        avatar.positions[len(avatar) // 2 :] += 10.0
    near = avatar.nearness()
    assert set(near.tolist()) == {0.0, 1.0}
    params = random_params()
    other = replace(params, expression=params.expression + 1.0)
    moved = (avatar(params).means != avatar(other).means).any(dim=1)
    assert torch.equal(moved, near > 0)


@pytest.mark.parametrize("name", NAMES)
def test_the_neck_moves_gaussians_through_the_pose_networks_alone(name: str) -> None:
    avatar = lively(name)
    rest = replace(random_params(), neck=rest_params().neck)
    turned = replace(rest, neck=random_params(3).neck)
    assert not torch.allclose(avatar(turned).means, avatar(rest).means, atol=1e-5)
    with torch.no_grad():  # so that the neck is no input of the networks
        for network in (avatar.networks.pose.deformation, avatar.networks.pose.attributes, avatar.networks.pose.colour):
            network.layers[0].weight.zero_()
            network.layers[network.again].weight.zero_()
    for before, after in zip(avatar(rest), avatar(turned), strict=True):
        torch.testing.assert_close(after, before)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_the_small_image_is_the_cameras_own_and_sides_need_be_no_multiples(factor: int) -> None:
    avatar = lively("gaussianheadavatar", f"model.upsampling={factor}")
    gaussians = avatar(random_params())
    small = small_camera(CAMERA, factor)
    assert (small.width, small.height) == (-(-51 // factor), -(-43 // factor))
    points = torch.randn(5, 3) * 0.1
    torch.testing.assert_close(small.project(points)[:, :2] * factor, CAMERA.project(points)[:, :2])
    image, rgb = avatar.training_images(gaussians, CAMERA, WHITE, 0)
    assert image.shape == (43, 51, 3) and rgb.shape == (small.height, small.width, 3)
    white = torch.ones(gaussians.features.shape[1])
    reference = splat_features(*gaussians, small, white, backend="reference", blur=avatar.config.blur)
    torch.testing.assert_close(rgb, reference.image[..., :3], rtol=0, atol=1e-4)


def test_another_background_shows_where_the_avatar_is_not() -> None:
    avatar = lively("gaussianheadavatar")
    gaussians, other = avatar(random_params()), torch.tensor([0.2, 0.5, 0.9])
    white, coloured = (avatar.draw(gaussians, CAMERA, colour) for colour in (WHITE, other))
    torch.testing.assert_close(
        coloured.image, white.image + (1 - white.alpha)[..., None] * (other - 1.0), rtol=0, atol=1e-6
    )
    assert 0.1 < float(white.alpha.detach().mean()) < 1.0


@pytest.mark.parametrize(("alpha", "share"), [(0.0, 0.0), (0.03, 0.1), (0.3, 1.0), (0.9, 1.0)])
def test_the_picture_fades_into_the_background_where_splats_hardly_cover_it(alpha: float, share: float) -> None:
    avatar = lively("gaussianheadavatar")
    small = avatar.splatted(avatar(random_params()), CAMERA)
    image = avatar.enlarged(small._replace(alpha=torch.full_like(small.alpha, alpha)), CAMERA, WHITE).image
    upsampled = avatar.upsampler(small.image)[: CAMERA.height, : CAMERA.width]
    torch.testing.assert_close(image, 1.0 + share * (upsampled - 1.0), rtol=0, atol=1e-6)


def test_the_networks_see_the_heads_turn_against_its_mean() -> None:
    avatar = lively("gaussianheadavatar")
    mean = matrix_from_6d(random_params(4).neck)
    avatar.learn_head_rotation(mean[None])
    params = rest_params()
    torch.testing.assert_close(avatar.pose(params, mean), torch.zeros(6), rtol=0, atol=1e-3)
    torch.testing.assert_close(avatar.pose(params, None), torch.zeros(6), rtol=0, atol=1e-6)
    half_turn = mean @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    torch.testing.assert_close(avatar.pose(params, half_turn)[:3].norm(), torch.tensor(torch.pi), rtol=0, atol=1e-3)


@pytest.mark.parametrize(("name", "start"), [*((name, "frames") for name in NAMES), (NAMES[0], "surface")])
def test_it_starts_on_the_mesh_and_on_hull_or_surface_in_the_colours_of_training_frames(
    name: str, start: str, tracked_folder: Path, two_threads: None
) -> None:
    """Several threads add up no gradient in another order the second time."""
    config = small_config(f"model={name}", f"trainer.initialization={start}")
    _, subject, assets = open_small(tracked_folder, config)
    found = []
    for one in (subject, poisoned(subject)):
        avatar = new_avatar(assets, subject, config)
        assert isinstance(avatar, GaussianHeadAvatar)
        initialize_from_frames(avatar, one, config)
        found.append(avatar)
    first, second = found
    for key, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[key]), f"{key} has seen held-out frames"
    assert bool(torch.isfinite(first.log_scales).all())
    frame = subject.frame(subject.split.train[0])
    screen = frame.camera.project(first(frame.params).means.detach())
    inside = (screen[:, 0] > 0) & (screen[:, 0] < frame.camera.width)
    assert float(inside.float().mean()) > 0.9


@pytest.mark.parametrize("name", [*NAMES[:2], pytest.param(NAMES[2], marks=pytest.mark.slow)])
def test_a_head_of_one_colour_starts_in_that_colour(
    name: str, tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model, "FIT_STEPS", FIT_STEPS)
    config = small_config(f"model={name}")
    _, subject, assets = open_small(tracked_folder, config)
    avatar, colour = new_avatar(assets, subject, config), torch.tensor([0.8, 0.1, 0.3])
    frames = [subject.frame(i) for i in subject.split.train[::4]]
    avatar.initialize_from([replace(f, image=colour.expand_as(f.image)) for f in frames], "frames")
    gaussians = avatar(frames[0].params)
    screen = frames[0].camera.project(gaussians.means.detach())
    nearest = screen[:, 2] < screen[:, 2].median()  # the side that faces the camera
    error = (gaussians.features[nearest, :3] - colour).abs().median()
    assert float(error) < 0.05


def test_masks_that_have_nothing_in_common_get_a_sentence(tracked_folder: Path) -> None:
    config = small_config("model=gaussianheadavatar")
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    frames = [subject.frame(i) for i in subject.split.train[:4]]
    with pytest.raises(UserError, match="nowhere to start.*avatar check"):
        avatar.initialize_from([replace(f, alpha=torch.zeros_like(f.alpha)) for f in frames], "frames")


def test_a_head_model_with_empty_regions_starts_as_one_without_them(tracked_folder: Path) -> None:
    config = small_config("model=gaussianheadavatar")
    _, subject, assets = open_small(tracked_folder, config)
    others = {name: index for name, index in assets.regions.items() if name not in ("face", "lips")}
    empty = dict.fromkeys(("face", "lips"), torch.zeros(0, dtype=torch.int64))
    frames, found = [subject.frame(i) for i in subject.split.train[:4]], []
    for regions in (others, others | empty):
        avatar = new_avatar(replace(assets, regions=regions), subject, config)
        assert isinstance(avatar, GaussianHeadAvatar)
        avatar.initialize_from(frames, "frames")
        found.append(avatar.state_dict()["positions"])
    torch.testing.assert_close(*found, rtol=0, atol=0)


def test_a_head_model_whose_neck_does_not_bend_is_as_long_as_all_of_it() -> None:
    assets = grid_head()
    stiff = replace(assets, weights=torch.eye(5)[:1].expand_as(assets.weights).contiguous())  # all on the root
    avatar = make_avatar(stiff, torch.zeros(3), small_config("model=gaussianheadavatar").model)
    assert isinstance(avatar, GaussianHeadAvatar)
    heights = avatar.head.neutral_vertices()[:, 1]
    assert avatar.unit == pytest.approx(0.5 * float(heights.max() - heights.min()))
    assert bool(torch.isfinite(avatar(random_params(), None, torch.eye(3)).means).all())


def test_fewer_steps_have_higher_rates() -> None:
    avatar = lively("gaussianheadavatar")

    def rate(iterations: int) -> float:
        return avatar.parameter_groups(small_config(f"trainer.iterations={iterations}").trainer)["network"][1]

    assert rate(600_000) == 1e-4 and rate(150_000) == pytest.approx(2e-4) and rate(10) == pytest.approx(1e-3)
