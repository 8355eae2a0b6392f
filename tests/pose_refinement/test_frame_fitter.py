"""How well a picture fits, and its gradient: against autograd through the reference, and against finite differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partialmethod
from pathlib import Path

import pytest
import torch
from drawn_clip import BACKGROUND, EXPRESSIONS, SIZE, Clip, drawn_clip, patterned_avatar, wrongly_tracked
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from avatar.gaussians.base_model import Avatar
from avatar.losses.metrics import psnr
from avatar.pose_refinement import frame_fitter as fitter_module
from avatar.pose_refinement.frame_fitter import (
    OBSERVATIONS,
    PIXEL_SIGMA,
    FrameFitter,
    head_psnr,
    targets,
)
from avatar.pose_refinement.frame_fitter import misfit as misfit_of
from avatar.pose_refinement.refine_subject import frozen
from avatar.pose_refinement.tracking_values import HeadPose, head_params, moved_pose, values_of
from avatar.splat import splat

VALUES = 20 + EXPRESSIONS


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Avatar]:
    avatar = patterned_avatar(tmp_path_factory.mktemp("head"), "model.blur=0.3")
    with frozen(avatar):
        yield avatar


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    return drawn_clip(avatar, frames=4, train=3)


@pytest.fixture
def fitter(avatar: Avatar) -> FrameFitter:
    return FrameFitter(avatar, BACKGROUND, avatar.head.neutral_vertices().mean(dim=0))


def given(clip: Clip, index: int) -> HeadPose:
    return HeadPose(clip.recording.tracks["R"][index], clip.recording.tracks["t"][index])


def mistracked(clip: Clip) -> tuple[torch.Tensor, HeadPose]:
    """Values away from zero in everything, and the given pose, of frame 2."""
    wrong = wrongly_tracked(clip, degrees=1.5, mm=3.0, share=0.5)
    values = values_of(wrong.recording.tracks)[2]
    generator = torch.Generator().manual_seed(1)
    values[:9] += torch.randn(9, generator=generator) * torch.tensor([0.01] * 3 + [0.002] * 3 + [0.02] * 3)
    return values, given(wrong, 2)


@pytest.mark.parametrize("level", [0, 1])
def test_the_gradient_is_that_through_the_reference(fitter: FrameFitter, clip: Clip, level: int) -> None:
    """The reference splatter is differentiable in its camera and computes the colours itself."""
    check_gradient(fitter, clip, level)


def test_the_gradient_of_gaussians_that_never_turn_is_that_through_the_reference(tmp_path: Path) -> None:
    avatar = patterned_avatar(tmp_path, "model=ndgs")
    with torch.no_grad():
        for parameter in avatar.hyper.parameters():
            parameter += 0.02 * torch.randn_like(parameter)
    with frozen(avatar):
        check_gradient(
            FrameFitter(avatar, BACKGROUND, avatar.head.neutral_vertices().mean(dim=0)), drawn_clip(avatar, 4, 3)
        )


def test_the_gradient_of_gaussians_that_the_mesh_turns_is_that_through_the_reference(tmp_path: Path) -> None:
    avatar = patterned_avatar(tmp_path, "model=splattingavatar")
    with frozen(avatar):
        check_gradient(
            FrameFitter(avatar, BACKGROUND, avatar.head.neutral_vertices().mean(dim=0)), drawn_clip(avatar, 4, 3)
        )


def test_the_gradient_knows_what_the_network_is_told_of_a_turn(tmp_path: Path) -> None:
    avatar = patterned_avatar(tmp_path, "model.head_rotation=true")
    clip = drawn_clip(avatar, 4, 3)
    avatar.learn_head_rotation(clip.recording.tracks["R"])
    assert avatar.deformation is not None and avatar.hyper is not None
    with torch.no_grad():
        for parameter in (*avatar.hyper.parameters(), *avatar.deformation.parameters()):
            parameter += 0.03 * torch.randn_like(parameter)
    fitter = FrameFitter(avatar, BACKGROUND, avatar.head.neutral_vertices().mean(dim=0))
    (values, pose), target = mistracked(clip), targets(clip.pictures[2], BACKGROUND, 1)
    assert target is not None
    with frozen(avatar):
        check_gradient(fitter, clip)
        told = fitter.fit(values, pose, [target[0]]).gradient[:3]
        avatar.turning *= 0.0
        untold = fitter.fit(values, pose, [target[0]]).gradient[:3]
    assert float((told - untold).norm()) > 0.02 * float(told.norm())


def check_gradient(fitter: FrameFitter, clip: Clip, level: int = 0) -> None:
    target = targets(clip.pictures[2], BACKGROUND, 2)[level]
    values, pose = mistracked(clip)
    found = fitter.fit(values, pose, [target])

    moving = values.clone().requires_grad_()
    moved = moved_pose(moving, pose, fitter.centre)
    camera = replace(target.camera, R_cam_world=moved.R, t_cam_world=moved.t)
    gaussians = fitter.avatar(head_params(moving), None, moved.R)
    blur = target.shrink * fitter.avatar.config.blur
    options = {"backend": "reference", "region": target.box, "blur": blur}
    image = splat(gaussians, camera, BACKGROUND, **options).image[target.box]
    misfit = misfit_of([image], [target])
    (expected,) = torch.autograd.grad(misfit, moving)
    assert found.misfit == pytest.approx(misfit.item(), rel=1e-4)
    assert torch.allclose(found.pictures[0], image, atol=1e-3)
    assert torch.allclose(found.gradient, expected, rtol=5e-3, atol=1e-3 * float(expected[6:].abs().max()))
    assert float(expected[:3].abs().min()) > 1.0


def test_the_gradient_is_the_slope(fitter: FrameFitter, clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    # Where a splat ends makes finite differences jump; without the cut-off they do not.
    monkeypatch.setattr(Avatar, "draw", partialmethod(Avatar.draw, alpha_min=0.0, t_min=0.0))
    target = targets(clip.pictures[2], BACKGROUND, 1)[0]
    values, pose = mistracked(clip)
    found = fitter.fit(values, pose, [target])
    assert found.misfit == pytest.approx(float(fitter.figures(values, pose, [target])[0]), rel=1e-5)
    # Turns out of the picture's plane also change which splat is in front of which, in jumps.
    for k, length in ((2, 1e-3), (3, 2e-4), (4, 2e-4), (5, 2e-4), (10, 1e-3), (22, 1e-3), (24, 1e-3)):
        step = torch.zeros(VALUES)
        step[k] = length
        high, low = (float(fitter.figures(values + sign * step, pose, [target])[0]) for sign in (1, -1))
        assert float(found.gradient[k]) == pytest.approx((high - low) / (2 * length), rel=0.03, abs=0.1), k


def test_the_misfit_counts_squares_in_observations(fitter: FrameFitter, clip: Clip) -> None:
    target = targets(clip.pictures[0], BACKGROUND, 1)[0]
    values = values_of(clip.recording.tracks)[0]
    fits = float(fitter.figures(values, given(clip, 0), [target])[0])
    grey = replace_picture(target, fitter.pictures(values, given(clip, 0), [target])[0] + 0.02)
    expected = 0.5 * OBSERVATIONS * (0.02 / PIXEL_SIGMA) ** 2 * target.picture[..., 0].numel() / target.area
    assert float(fitter.figures(values, given(clip, 0), [grey])[0]) == pytest.approx(expected, rel=1e-3)
    assert fits < 0.1 * expected  # the clip is the avatar's own picture
    far = replace_picture(target, fitter.pictures(values, given(clip, 0), [target])[0] + 0.4)
    # An outlier counts less than its square.
    assert float(fitter.figures(values, given(clip, 0), [far])[0]) < 400 * 0.5 * expected


def replace_picture(target: fitter_module.Target, picture: torch.Tensor) -> fitter_module.Target:
    return target._replace(picture=picture)


def test_targets_are_the_head_with_a_margin_at_every_size(clip: Clip) -> None:
    frame = clip.pictures[0]
    full, half = targets(frame, BACKGROUND, 2)
    rows = frame.head_mask.any(dim=1).nonzero()[:, 0]
    assert full.box[0] == slice(max(int(rows[0]) - 8, 0), min(int(rows[-1]) + 9, SIZE))
    assert torch.equal(full.picture, frame.composite(BACKGROUND)[full.box]) and full.shrink == 1
    assert (half.camera.width, half.camera.fx) == (SIZE // 2, frame.camera.fx / 2) and half.shrink == 0.25
    assert half.area == pytest.approx(full.area / 4, rel=1e-5)
    assert targets(replace(frame, head_mask=torch.zeros(SIZE, SIZE)), BACKGROUND, 2) is None


def test_a_half_size_picture_looks_like_the_full_one(fitter: FrameFitter, clip: Clip) -> None:
    """The splatter's blur is in pixels: at half the size it would thicken every splat twice as much."""
    full, half = targets(clip.pictures[1], BACKGROUND, 2)
    values = values_of(clip.recording.tracks)[1]
    sharp, thick = (
        head_psnr(fitter.pictures(values, given(clip, 1), [half._replace(shrink=shrink)]), [half])
        for shrink in (0.25, 1.0)
    )
    assert sharp > thick + 3.0
    assert head_psnr(fitter.pictures(values, given(clip, 1), [full]), [full]) > 45.0


def test_psnr_is_of_the_head_alone(clip: Clip) -> None:
    target = targets(clip.pictures[0], BACKGROUND, 1)[0]
    other = (target.picture + 0.1 * (1 - target.mask)[..., None]).clamp(0, 1)
    assert head_psnr([other], [target]) == float("inf") or head_psnr([other], [target]) > 100
    grey = target.picture * 0.9
    assert head_psnr([grey], [target]) == pytest.approx(float(psnr(grey, target.picture, target.mask)))


def test_the_pose_is_that_of_the_values(fitter: FrameFitter, clip: Clip) -> None:
    """Moving by the difference of two trackings gives the other's picture."""
    wrong = wrongly_tracked(clip)
    target = targets(clip.pictures[1], BACKGROUND, 1)[0]
    right, off = given(clip, 1), given(wrong, 1)
    turn = right.R @ off.R.T
    values = values_of(clip.recording.tracks)[1]
    values[:3] = rotation_matrix_to_axis_angle(turn[None])[0]
    centre = fitter.centre
    values[3:6] = (right.R @ centre + right.t) - (off.R @ centre + off.t)
    moved = moved_pose(values, off, centre)
    assert torch.allclose(moved.R, right.R, atol=1e-5) and torch.allclose(moved.t, right.t, atol=1e-6)
    assert head_psnr(fitter.pictures(values, off, [target]), [target]) > 45.0
