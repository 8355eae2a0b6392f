"""What is particular to the C++ kernel: reproducibility, threads, instruction sets, its own finite differences."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import threading
from dataclasses import replace

import pytest
import torch
from splat.scenes import (
    POSE,
    SCENES,
    SIMD,
    Scene,
    assert_agrees,
    camera,
    gradients,
    in_float64,
    inputs_of,
    random_gaussians,
    render,
    single_splat,
    use_simd,
    with_inputs,
)

from avatar import _core
from avatar.splat.scenes import head_camera, head_shell
from avatar.types import Gaussians

HEAD = Scene(head_shell(), head_camera(200), torch.ones(3))


def _everything(scene: Scene) -> list[torch.Tensor]:
    """Image, alpha and all gradients for one cotangent."""
    with torch.no_grad():
        image, alpha = render(scene)
    g = torch.Generator().manual_seed(1)
    cotangents = torch.randn(image.shape, generator=g), torch.randn(alpha.shape, generator=g)
    return [image, alpha, *gradients(scene, "cpu", *cotangents).values()]


def test_repeats_are_equal_to_the_bit() -> None:
    first = _everything(HEAD)
    for _ in range(3):
        assert all(torch.equal(a, b) for a, b in zip(_everything(HEAD), first, strict=True))


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("name", ["head", "17x33", "1x1", "needles"])
def test_threads_1_2_and_5_agree_to_the_bit(name: str, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    found = {}
    for threads in (1, 2, 5):
        monkeypatch.setenv("AVATAR_THREADS", str(threads))
        found[threads] = _everything(SCENES[name])
    for threads in (2, 5):
        assert all(torch.equal(a, b) for a, b in zip(found[threads], found[1], strict=True))


def test_instruction_sets_agree_to_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = SCENES["random"]
    monkeypatch.setenv("AVATAR_SIMD", "baseline")
    baseline = render(scene)
    use_simd(monkeypatch, "avx2")
    assert (render(scene).image - baseline.image).abs().max() < 5e-6


@pytest.mark.parametrize("simd", SIMD)
def test_falloff_has_the_relative_precision_of_float32(simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # A white splat on black is its alpha, down to 1e-13 of the middle's; the exponent's rounding grows with it, the
    # exponential, opacity and colour add 4e-7.
    use_simd(monkeypatch, simd)
    scene = replace(single_splat(opacity=0.9, scale=0.03, colour=1.0), background=torch.zeros(3))
    scene = scene.with_options(alpha_min=0.0, t_min=0.0)
    found, expected = render(scene).image[..., 0].double(), render(in_float64(scene), "reference").image[..., 0]
    assert 1e-14 < expected.min() < 1e-10
    assert ((found / expected - 1).abs() < 4e-7 + 3e-7 * (0.9 / expected).log()).all()


def test_unknown_instruction_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_SIMD", "sse9")
    with pytest.raises(ValueError, match="AVATAR_SIMD must be baseline, avx2 or avx512, got sse9"):
        render(SCENES["1x1"])


@pytest.mark.parametrize("text", ["0", "-1", "many", "", "100000"])
def test_impossible_number_of_threads_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_THREADS", text)
    with pytest.raises(ValueError, match="AVATAR_THREADS must be a number of threads from 1 to 1024"):
        render(SCENES["1x1"])


@pytest.mark.parametrize("field", [*Gaussians._fields, "background", *POSE])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradient_is_the_finite_difference_of_the_kernel(field: str, antialiased: bool) -> None:
    g = random_gaussians(40, seed=3, spread=0.15, size=0.04, anisotropy=0.4)
    # Opacities below the cap, colours away from the clamp: no kinks, so that differences of float32 images mean something.
    g = g._replace(opacities=0.1 + 0.6 * g.opacities, sh=0.3 * g.sh)
    scene = Scene(g, camera(48, 40), options={"alpha_min": 0.0, "t_min": 0.0, "antialiased": antialiased})
    weights_image, weights_alpha = torch.randn(40, 48, 3), torch.randn(40, 48)
    grad = gradients(scene, "cpu", weights_image, weights_alpha)[field]

    inputs = inputs_of(scene)
    value = inputs[field]
    direction = grad / grad.norm() * value.abs().mean()
    step = 2e-3

    def loss(amount: float) -> float:
        image, alpha = render(with_inputs(scene, {**inputs, field: value + amount * direction}))
        return float((image.double() * weights_image).sum() + (alpha.double() * weights_alpha).sum())

    # Richardson's extrapolation of two central differences: the error is of the fourth order in the step.
    coarse, fine = ((loss(h) - loss(-h)) / (2 * h) for h in (2 * step, step))
    difference = (4 * fine - coarse) / 3
    expected = float((grad.double() * direction).sum())
    assert difference == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("t_min", [0.0, 1e-20, 1e-4])
def test_gradients_hold_where_the_transmittance_is_tiny(
    t_min: float, simd: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The backward pass finds each transmittance by division from the one behind, here down to 1e-30.
    use_simd(monkeypatch, simd)
    g = random_gaussians(60, seed=8, spread=0.03, size=0.3)._replace(opacities=torch.linspace(0.9, 1.0, 60))
    assert_agrees(Scene(g, camera(33, 20), options={"alpha_max": 0.9999, "t_min": t_min}))


@pytest.mark.parametrize("simd", SIMD)
def test_gradients_hold_behind_thousands_of_faint_splats(simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    g = random_gaussians(4000, seed=9, sh_degree=0, spread=0.02, size=0.5, anisotropy=0.1)
    scene = Scene(g._replace(opacities=torch.full((4000,), 0.005)), camera(20, 20))
    scene = scene.with_options(alpha_min=0.0)  # or cut-offs would fall on many pixels
    # The splats' gradients cancel to a three-hundredth in those of the pose, which are their sums.
    assert_agrees(scene, pose_tolerance=1e-3)
    assert (1 - render(scene).alpha).max() < 0.995**1000, "more than a thousand splats at every pixel"


def test_two_python_threads_may_draw_at_once() -> None:
    alone = _everything(HEAD)
    found: list[list[torch.Tensor]] = []
    threads = [threading.Thread(target=lambda: found.append(_everything(HEAD))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert len(found) == 4
    assert all(torch.equal(a, b) for result in found for a, b in zip(result, alone, strict=True))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_child_draws_with_threads_of_its_own() -> None:
    script = """
        import os, sys, torch
        torch.set_num_threads(1)
        from avatar.splat import splat
        from avatar.types import Camera, Gaussians
        g = Gaussians(torch.rand(5000, 3) - 0.5, torch.randn(5000, 4), 0.02 * torch.rand(5000, 3), torch.rand(5000),
                      torch.rand(5000, 1, 3))
        camera = Camera(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]), 100.0, 100.0, 50.0, 50.0, 100, 100)
        before = splat(g, camera, torch.zeros(3)).image
        child = os.fork()
        if child == 0:
            os._exit(0 if torch.equal(splat(g, camera, torch.zeros(3)).image, before) else 3)
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    environment = {**os.environ, "AVATAR_THREADS": "3"}
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], env=environment, timeout=120, check=False)
    assert done.returncode == 0


def test_backward_may_run_twice_and_later() -> None:
    scene = SCENES["random"]
    leaf = scene.gaussians.means.clone().requires_grad_()
    drawn = render(replace(scene, gaussians=scene.gaussians._replace(means=leaf)))
    render(SCENES["17x33"])  # another drawing in between leaves no trace
    first = torch.autograd.grad(drawn.image.sum(), leaf, retain_graph=True)[0]
    assert torch.equal(torch.autograd.grad(drawn.image.sum(), leaf)[0], first)


def test_second_derivative_is_refused() -> None:
    scene = SCENES["one"]
    leaf = scene.gaussians.means.clone().requires_grad_()
    drawn = render(replace(scene, gaussians=scene.gaussians._replace(means=leaf)))
    (first,) = torch.autograd.grad(drawn.image.square().sum(), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_strided_inputs_and_cotangents_are_read_as_what_they_show() -> None:
    scene = SCENES["17x33"]
    g = scene.gaussians
    strided = Gaussians(*(torch.stack((f, f), dim=-1)[..., 0] for f in g))
    assert not strided.means.is_contiguous()
    cotangent = torch.randn(3, 33, 17).permute(1, 2, 0)
    expected = gradients(scene, "cpu", cotangent.contiguous(), None)
    found = gradients(replace(scene, gaussians=strided), "cpu", cotangent, None)
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_no_output_memory_is_left_uninitialised() -> None:
    g = random_gaussians(500, spread=2.0)  # many hidden, some tiles empty, some pixels never reached
    view = camera(83, 57)
    image, alpha = torch.full((57, 83, 3), torch.nan), torch.full((57, 83), torch.nan)
    drawing = _core.splat_forward(
        **g._asdict(),
        background=torch.zeros(3),
        rotation=view.R_cam_world.flatten().tolist(),
        translation=view.t_cam_world.tolist(),
        intrinsics=(view.fx, view.fy, view.cx, view.cy),
        sh_degree=1,
        cutoffs=(1 / 255, 0.999, 1e-4),
        blur=0.3,
        near=0.01,
        antialiased=False,
        region=(0, 0, 83, 57),
        simd="",
        threads=2,
        image=image,
        alpha=alpha,
    )
    assert drawing is not None
    assert torch.isfinite(image).all() and torch.isfinite(alpha).all()
    outputs = {f"grad_{name}": torch.full_like(field, torch.nan) for name, field in g._asdict().items()}
    outputs["grad_background"] = torch.full((3,), torch.nan)
    outputs["grad_pose"] = torch.full((12,), torch.nan, dtype=torch.float64)
    cotangents = {"grad_image": torch.randn(57, 83, 3), "grad_alpha": torch.randn(57, 83)}
    _core.splat_backward(drawing=drawing, **g._asdict(), **cotangents, **outputs)
    assert all(torch.isfinite(output).all() for output in outputs.values())
    assert (outputs["grad_means"] == 0).all(-1).any() and (outputs["grad_means"] != 0).any()
