"""Random scenes with poison values: no silent corruption, no hang, no allocation without bound.

Hypothesis shrinks what it finds to the smallest scene, so it draws them one by one: a fiftieth of AVATAR_STRESS_EXAMPLES
for each test, and a short run for every day. tests/stress/test_random_scenes.py draws that number, in batches.
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splat.scenes import Scene, ambiguous_pixels, assert_gradients_close, gradients, in_float64, render

from avatar.types import Camera, Gaussians

pytestmark = pytest.mark.slow

EXAMPLES = max(60, int(os.environ.get("AVATAR_STRESS_EXAMPLES", "0")) // 50)
stress = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
    print_blob=True,
)

F32 = np.float32
EDGE = F32(1 / 255)
OPACITIES = [0.0, 1e-38, float(np.nextafter(EDGE, F32(0))), float(EDGE), 0.01, 0.5, 0.99]
OPACITIES += [float(np.nextafter(F32(0.999), F32(0))), float(F32(0.999)), 1.0]
SCALES = [1e-12, 1e-8, 1e-4, 1e-3, 0.01, 0.03, 0.1, 1.0, 1e3, 1e6]
COORDINATES = [0.0, -0.0, 1e-12, 0.1, -0.1, 0.5, -0.5, 3.0, -3.0, 1e4, -1e4]
DEPTHS = [-1e30, -1.0, 0.0, 1e-30, 0.00999, 0.01, 0.0101, 0.1, 1.0, 1.0, 1.0, 2.0, 50.0, 1e6, 1e30]
QUATERNIONS = [0.0, 1e-38, 1e-20, 0.5, -0.5, 1.0, -1.0, 1e20, 3e38]
COEFFICIENTS = [0.0, 0.3, -0.3, 1.0, -5.0, 1e-30, 1e30]
SIZES = [1, 2, 15, 16, 17, 31, 32, 33, 48, 65]
NON_FINITE = [math.nan, math.inf, -math.inf]


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.sampled_from(SIZES)), draw(st.sampled_from(SIZES))
    focal = max(width, height) * draw(st.sampled_from([0.02, 0.5, 1.5, 100.0]))
    yaw = draw(st.sampled_from([0.0, 0.4, 1.5, math.pi]))
    c, s = math.cos(yaw), math.sin(yaw)
    # float32 poses of float64 cameras: what a prepared subject holds.
    R = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    cx, cy = (draw(st.sampled_from([0.5, 0.0, -1.5, 2.0, 0.37])) for _ in range(2))
    return Camera(R, torch.zeros(3), focal, focal * 1.1, cx * width, cy * height, width, height)


@st.composite
def scenes(draw: st.DrawFn, *, poison: bool) -> Scene:
    """`poison` draws every number from the lists above; without, a plain random scene of the same variety of cameras."""
    count = draw(st.sampled_from([0, 1, 2, 7, 30]))
    degree = draw(st.integers(0, 3))
    coefficients = (degree + 1) ** 2
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = draw(cameras())

    def pick(values: list[float], *shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.choice(np.array(values, dtype=F32), size=shape))

    if poison:
        in_camera = torch.cat((pick(COORDINATES, count, 2), pick(DEPTHS, count, 1)), dim=1)
        gaussians = Gaussians(
            in_camera @ camera.R_cam_world,
            pick(QUATERNIONS, count, 4),
            pick(SCALES, count, 3),
            pick(OPACITIES, count),
            pick(COEFFICIENTS, count, coefficients, 3),
        )
    else:
        depth = torch.from_numpy(rng.uniform(0.5, 3.0, (count, 1)).astype(F32))
        middle = torch.tensor([camera.width / 2 - camera.cx, camera.height / 2 - camera.cy]) / camera.fx
        spread = (
            torch.from_numpy(rng.normal(size=(count, 2)).astype(F32)) * max(camera.width, camera.height) / camera.fx
        )
        in_camera = torch.cat(((middle + 0.5 * spread) * depth, depth), dim=1)
        pixel = 1 / camera.fx
        gaussians = Gaussians(
            in_camera @ camera.R_cam_world,
            torch.from_numpy(rng.normal(size=(count, 4)).astype(F32)),
            torch.from_numpy((pixel * np.exp(rng.uniform(-2, 4, (count, 3)))).astype(F32)),
            torch.from_numpy(rng.uniform(0, 1, count).astype(F32)),
            torch.from_numpy(rng.normal(0, 0.4, (count, coefficients, 3)).astype(F32)),
        )
    options = {"antialiased": draw(st.booleans()), "sh_degree": draw(st.integers(0, degree))}
    if draw(st.booleans()):
        options |= {"alpha_min": 0.0, "t_min": 0.0}
    return Scene(gaussians, camera, options=options)


@stress
@given(scenes(poison=False))
def test_random_scenes_agree_with_the_reference(scene: Scene) -> None:
    ambiguous, jump = ambiguous_pixels(scene)
    with torch.no_grad():
        found, expected = render(scene), render(in_float64(scene), "reference")
    scale = 1 + expected.image.abs().max()
    allowed = 1e-5 * scale + torch.where(ambiguous, 1.001 * jump, 0.0)
    assert ((found.image - expected.image).abs().amax(-1) <= allowed).all()
    assert ((found.alpha - expected.alpha).abs() <= allowed).all()

    g = torch.Generator().manual_seed(0)
    grad_image = torch.randn(found.image.shape, generator=g).masked_fill(ambiguous[..., None], 0.0)
    grad_alpha = torch.randn(found.alpha.shape, generator=g).masked_fill(ambiguous, 0.0)
    wanted = gradients(in_float64(scene), "reference", grad_image.double(), grad_alpha.double())
    assert_gradients_close(gradients(scene, "cpu", grad_image, grad_alpha), wanted, tolerance=1e-3)


@stress
@given(scenes(poison=True))
def test_poison_values_give_the_reference_s_image_and_finite_gradients(scene: Scene) -> None:
    with torch.no_grad():
        expected = render(in_float64(scene), "reference")
        found = render(scene)
    assert torch.isfinite(found.image).all()
    assert ((found.alpha >= 0) & (found.alpha <= 1)).all()
    ambiguous, jump = ambiguous_pixels(scene)
    # What float32 can promise is the weight of each colour, so with colours of 1e30 errors are in units of those.
    scale = 1 + (scene.gaussians.sh.abs().max().item() if scene.gaussians.sh.numel() else 0.0)
    assert ((found.alpha - expected.alpha).abs() <= 1e-5 + torch.where(ambiguous, 1.001 * jump, 0.0)).all()
    error = (found.image - expected.image).abs().amax(-1)
    assert (error <= 1e-5 * scale + torch.where(ambiguous, 1.001 * jump, 0.0)).all()
    for grad in gradients(scene, "cpu", torch.ones_like(found.image), torch.ones_like(found.alpha)).values():
        assert not grad.isnan().any()


@stress
@given(scenes(poison=True), st.sampled_from(Gaussians._fields), st.sampled_from(NON_FINITE), st.data())
def test_one_non_finite_number_anywhere_is_reported(scene: Scene, name: str, value: float, data: st.DataObject) -> None:
    tensor = getattr(scene.gaussians, name)
    if tensor.numel() == 0:
        return
    at = data.draw(st.integers(0, tensor.numel() - 1))
    tensor.view(-1)[at] = value
    with pytest.raises(ValueError, match=f"{name} has 1 non-finite of {tensor.numel()} values"):
        render(scene)


def test_a_million_splats() -> None:
    count = 1_000_000
    g = torch.Generator().manual_seed(0)
    scene = Scene(
        Gaussians(
            torch.randn(count, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0]),
            torch.randn(count, 4, generator=g),
            torch.full((count, 3), 0.003),
            torch.rand(count, generator=g),
            torch.rand(count, 1, 3, generator=g),
        ),
        Camera(torch.eye(3), torch.zeros(3), 200.0, 200.0, 128.0, 128.0, 256, 256),
    )
    grads = gradients(scene, "cpu", torch.ones(256, 256, 3), None)
    assert all(torch.isfinite(grad).all() for grad in grads.values())
    assert (grads["opacities"] != 0).sum() > 50_000
