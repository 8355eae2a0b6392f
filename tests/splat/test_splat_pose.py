"""The camera's pose as an input of a drawing: what it has a gradient in, and what that costs and changes.

That the gradient is right stands beside those of the other inputs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from kornia.geometry.conversions import vector_to_skew_symmetric_matrix
from splat.scenes import BACKENDS, GPU, POSE, Scene, camera, gradients, inputs_of, random_gaussians, render, with_inputs

from avatar.splat import cpu
from avatar.types import Camera

WIDTH, HEIGHT = 22, 17
SCENE = Scene(random_gaussians(40, seed=31), camera(WIDTH, HEIGHT, centre=(0.3, 0.6)))


def cotangents() -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    return torch.randn(HEIGHT, WIDTH, 3, generator=g), torch.randn(HEIGHT, WIDTH, generator=g)


def gradients_in(scene: Scene, backend: str, names: tuple[str, ...]) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image, and its gradients where only inputs of these names require one."""
    inputs = {name: tensor.clone() for name, tensor in inputs_of(scene).items()}
    leaves = [inputs[name].requires_grad_() for name in names]
    image = render(with_inputs(scene, inputs), backend).image
    found = torch.autograd.grad(image, leaves, cotangents()[0].to(image))
    return image.detach(), dict(zip(names, found, strict=True))


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_requires_a_gradient_changes_no_bit(backend: str) -> None:
    others = tuple(name for name in inputs_of(SCENE) if name not in POSE)
    expected = gradients(SCENE, backend, cotangents()[0], None)
    for names in (others, POSE, POSE[:1], POSE[1:]):
        image, found = gradients_in(SCENE, backend, names)
        assert torch.equal(image, render(SCENE, backend).image)
        for name, gradient in found.items():
            assert torch.equal(gradient, expected[name]), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_pose_that_inference_mode_has_drawn_is_trained_with(backend: str) -> None:
    scene = Scene(SCENE.gaussians, camera(WIDTH, HEIGHT, centre=(0.31, 0.62)))  # which nothing else has drawn
    with torch.inference_mode():
        render(scene, backend)
    image, found = gradients_in(scene, backend, ("means",))
    assert not image.is_inference() and found["means"].any()


def test_a_pose_without_a_gradient_costs_the_compiled_core_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    backward = cpu._core.splat_backward

    def noting(*arguments: Any, **named: Any) -> None:
        asked.append(named["grad_pose"] is not None)
        backward(*arguments, **named)

    monkeypatch.setattr(cpu._core, "splat_backward", noting)
    gradients_in(SCENE, "cpu", ("means", "background"))
    gradients_in(SCENE, "cpu", ("means", "t_cam_world"))
    assert asked == [False, True]


@pytest.mark.parametrize("backend", BACKENDS)
def test_moving_the_camera_is_moving_the_means(backend: str) -> None:
    found = gradients(SCENE, backend, *cotangents())
    expected = SCENE.camera.R_cam_world @ found["means"].sum(0)
    torch.testing.assert_close(found["t_cam_world"], expected, rtol=1e-4, atol=1e-5 * float(expected.norm()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_pose_of_other_types_and_strides_is_read_as_what_it_shows(backend: str) -> None:
    expected = gradients(SCENE, backend, cotangents()[0], None)
    R = SCENE.camera.R_cam_world.double().T.contiguous().T.requires_grad_()
    t = torch.stack((SCENE.camera.t_cam_world, torch.zeros(3)), dim=1)[:, 0].requires_grad_()
    assert not R.is_contiguous() and not t.is_contiguous()
    image = render(replace(SCENE, camera=replace(SCENE.camera, R_cam_world=R, t_cam_world=t)), backend).image
    by_R, by_t = torch.autograd.grad(image, (R, t), cotangents()[0])
    assert by_R.dtype == torch.float64 and by_t.dtype == torch.float32
    assert torch.equal(by_R.float(), expected["R_cam_world"]) and torch.equal(by_t, expected["t_cam_world"])


@pytest.mark.parametrize("backend", GPU)
def test_a_pose_on_the_gpu_draws_as_one_on_the_cpu(backend: str) -> None:
    if not torch.cuda.is_available():
        pytest.skip("torch sees no GPU")
    there = {name: tensor.cuda() for name, tensor in inputs_of(SCENE).items()}
    here = {**there, **{name: getattr(SCENE.camera, name) for name in POSE}}
    image, found = gradients_in(with_inputs(SCENE, there), backend, POSE)
    same, expected = gradients_in(with_inputs(SCENE, here), backend, POSE)
    assert torch.equal(image, same)
    for name in POSE:
        assert found[name].is_cuda and torch.equal(found[name].cpu(), expected[name])


def test_descent_finds_the_pose_that_a_picture_was_taken_from() -> None:
    scene = Scene(random_gaussians(60, seed=31, size=0.06, spread=0.2), camera(32, 24, centre=(0.4, 0.6)))
    picture = render(scene).image

    def moved(turn_and_shift: torch.Tensor) -> Camera:
        turn = torch.linalg.matrix_exp(vector_to_skew_symmetric_matrix(turn_and_shift[None, :3])[0])
        R, t = turn @ scene.camera.R_cam_world, scene.camera.t_cam_world + turn_and_shift[3:]
        return replace(scene.camera, R_cam_world=R, t_cam_world=t)

    def error(values: torch.Tensor) -> torch.Tensor:
        return (render(replace(scene, camera=moved(values))).image - picture).square().mean()

    begin, steps = torch.tensor([0.04, -0.05, 0.06, 0.02, -0.01, 0.03]), 60  # radians, metres
    values = begin.clone().requires_grad_()
    optimizer = torch.optim.Adam([values], lr=4e-3)
    fading = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        error(values).backward()
        optimizer.step()
        fading.step()
    assert values.detach().norm() < 0.1 * begin.norm()
    assert error(values.detach()) < 0.01 * error(begin)
