"""One test for every bug seen in public rasterisers; each is named after its bug."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from splat.loops import splat_by_loops
from splat.scenes import (
    BACKENDS,
    GPU,
    Scene,
    assert_agrees,
    assert_gradients_close,
    camera,
    gradients,
    in_float64,
    random_gaussians,
    render,
    single_splat,
)

from avatar.splat import CannotDraw
from avatar.types import Gaussians

KERNELS = ["cpu", *GPU]


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_is_counted_once_in_the_gradient_of_alpha(backend: str) -> None:
    scene = single_splat(opacity=0.5, colour=0.3)
    image_of_one = torch.zeros(33, 33, 3)
    image_of_one[16, 16] = torch.tensor([1.0, 2.0, 3.0])  # the pixel that the splat's centre hits: alpha = opacity
    found = gradients(scene, backend, image_of_one, None)["opacities"]
    expected = (torch.tensor([1.0, 2.0, 3.0]) * (0.3 - scene.background)).sum()
    torch.testing.assert_close(found[0], expected, rtol=1e-5, atol=1e-6)
    alpha_of_one = torch.zeros(33, 33)
    alpha_of_one[16, 16] = 5.0
    torch.testing.assert_close(gradients(scene, backend, None, alpha_of_one)["opacities"][0], torch.tensor(5.0))


def test_off_diagonal_gradient_of_a_rotated_anisotropic_splat() -> None:
    # A needle at 45 degrees lives by the off-diagonal term of its covariance; a factor of 2 there shows in full.
    half = math.radians(45) / 2
    g = single_splat().gaussians._replace(
        quats=torch.tensor([[math.cos(half), 0.0, 0.0, math.sin(half)]]), scales=torch.tensor([[0.08, 0.01, 0.02]])
    )
    scene = replace(single_splat(), gaussians=g)
    assert_agrees(scene)
    grad = gradients(scene, "cpu", torch.randn(33, 33, 3), None)
    assert grad["quats"].norm() > 0.1 and grad["scales"].norm() > 0.1


def test_forward_and_backward_have_the_same_alpha_cap() -> None:
    for cap in (0.5, 0.99, 0.999):
        scene = Scene(
            random_gaussians(80)._replace(opacities=torch.linspace(0.4, 1.0, 80)),
            camera(40, 30),
            options={"alpha_max": cap},
        )
        assert_agrees(scene)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradient_is_zero_where_alpha_is_clamped(backend: str) -> None:
    scene = single_splat(opacity=1.0)
    cotangent = torch.zeros(33, 33, 3)
    cotangent[16, 16] = 1.0
    grad = gradients(scene, backend, cotangent, None)
    assert grad["opacities"] == 0 and (grad["means"] == 0).all() and (grad["scales"] == 0).all()
    assert (grad["sh"] != 0).all()


def test_splats_behind_the_last_contributor_do_not_corrupt_the_gradient() -> None:
    wall = random_gaussians(40, seed=1, spread=0.02, size=0.3)._replace(opacities=torch.full((40,), 0.9))
    behind = random_gaussians(60, seed=2, spread=0.05)
    behind = behind._replace(means=behind.means + torch.tensor([0.0, 0.0, 0.6]))
    g = Gaussians(*(torch.cat(fields) for fields in zip(wall, behind, strict=True)))
    scene = Scene(g, camera(30, 30, yaw=0.0))
    assert_agrees(scene)
    cotangent = torch.randn(30, 30, 3)
    grads = gradients(scene, "cpu", cotangent, None)
    assert all((grads[name][40:] == 0).all() for name in Gaussians._fields)
    front = replace(scene, gaussians=Gaussians(*(f[:40] for f in g)))
    alone = gradients(front, "cpu", cotangent, None)
    assert_gradients_close(
        {n: grads[n][:40] for n in Gaussians._fields}, {n: alone[n] for n in Gaussians._fields}, 1e-6
    )


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("backend", BACKENDS)
def test_zero_splats_and_one_splat_do_not_crash(count: int, backend: str) -> None:
    scene = Scene(random_gaussians(count, spread=0.01), camera(20, 10))
    found = render(scene, backend)
    grads = gradients(scene, backend, torch.ones(10, 20, 3), torch.ones(10, 20))
    assert (found.alpha.max() > 0) == (count == 1)
    assert grads["means"].shape == (count, 3)


@pytest.mark.parametrize(
    "hidden", ["behind the camera", "in the plane of the camera", "beside the image", "transparent"]
)
@pytest.mark.parametrize("backend", BACKENDS)
def test_hidden_splats_leave_the_background_alone(hidden: str, backend: str) -> None:
    g = random_gaussians(300, size=0.002)
    x, y, z = g.means.unbind(-1)
    if hidden == "transparent":
        g = g._replace(opacities=g.opacities * np.float32(1 / 256))
    else:
        places = {"behind the camera": (x, y, -1.3 - z.abs()), "in the plane of the camera": (x, y, 0 * z - 1.2)}
        g = g._replace(means=torch.stack(places.get(hidden, (x + 9, y, z)), -1))
    scene = Scene(g, camera(40, 30, yaw=0.0))
    found, grads = render(scene, backend), gradients(scene, backend, torch.ones(30, 40, 3), torch.ones(30, 40))
    assert torch.equal(found.image, scene.background.expand(30, 40, 3)) and (found.alpha == 0).all()
    assert torch.equal(grads.pop("background"), torch.full((3,), 1200.0))
    assert all((grad == 0).all() for grad in grads.values())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("depth", [0.0, -1e-30, 1e-30, 0.00999, -1.0])
def test_a_splat_at_the_camera_gives_no_infinity(depth: float, backend: str) -> None:
    found = render(single_splat(depth=depth), backend)
    assert torch.equal(found.alpha, torch.zeros(33, 33))
    grads = gradients(single_splat(depth=depth), backend, torch.ones(33, 33, 3), torch.ones(33, 33))
    assert all(torch.isfinite(grad).all() for grad in grads.values())


def test_a_splat_just_beyond_the_near_plane_agrees() -> None:
    g = random_gaussians(30, size=0.01)
    means = g.means * torch.tensor([0.02, 0.02, 0.0]) + torch.tensor([0.0, 0.0, -1.2 + 0.0101])
    assert_agrees(Scene(g._replace(means=means), camera(32, 32, yaw=0.0)))


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize("scale", [1e-4, 1e-6, 1e-9, 1e-12, 1e-30, 0.0])
@pytest.mark.parametrize("antialiased", [False, True])
def test_tiny_scales_do_not_underflow_to_nan(scale: float, antialiased: bool, backend: str) -> None:
    g = random_gaussians(100)._replace(scales=scale * torch.tensor([[0.7, 1.0, 2.0]]).repeat(100, 1))
    size = 64 if backend == "cpu" else 32  # every splat is in every tile, and the interpreter takes seconds
    scene = Scene(g, camera(size, size), options={"alpha_min": 0.0, "antialiased": antialiased})
    assert_agrees(scene, backend)


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize(("scale", "x"), [(1e-36, 0.0), (1e-40, 0.0), (1e-44, 0.0), (0.01, 3e38)])
def test_splats_that_are_too_thin_or_too_far_for_float32_have_no_part(scale: float, x: float, backend: str) -> None:
    g = random_gaussians(30)
    g.scales[:5], g.means[:5, 0] = scale, x
    scene = Scene(g, camera(33, 33, yaw=0.0), options={"alpha_min": 0.0, "blur": 0.0})
    assert_agrees(scene, backend)
    grads = gradients(scene, backend, torch.ones(33, 33, 3), torch.ones(33, 33))
    assert all((grads[name][:5] == 0).all() for name in ("means", "quats", "scales"))


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (15, 16), (17, 1), (1, 50), (31, 33), (64, 7), (65, 95)])
def test_sizes_that_are_not_a_multiple_of_the_tile(width: int, height: int, backend: str) -> None:
    assert_agrees(Scene(random_gaussians(60), camera(width, height)), backend)


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_sign_of_a_scale_has_no_effect(antialiased: bool, backend: str) -> None:
    g, sign = random_gaussians(60), torch.tensor([-1.0, 1.0, -1.0])
    scene = Scene(g, camera(40, 30), options={"antialiased": antialiased})
    flipped = replace(scene, gaussians=g._replace(scales=g.scales * sign))
    assert torch.equal(render(flipped, backend).image, render(scene, backend).image)
    cotangent = torch.randn(30, 40, 3)
    expected, found = gradients(scene, backend, cotangent, None), gradients(flipped, backend, cotangent, None)
    assert torch.equal(found.pop("scales"), expected.pop("scales") * sign)
    assert all(torch.equal(found[name], expected[name]) for name in found)


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize(("focal", "spread"), [(1000.0, 3e-4), (100.0, 3e-3), (0.05, 0.8), (0.005, 3.0)])
def test_fields_of_view_from_a_twentieth_of_a_degree_to_179(focal: float, spread: float, backend: str) -> None:
    f = 48 * focal  # `focal` is in widths of the image
    view = replace(camera(48, 40), t_cam_world=torch.tensor([0.0, 0.0, 1.2]), fx=f, fy=f)
    scene = Scene(random_gaussians(80, spread=spread, size=spread / 10), view)
    assert render(scene).alpha.max() > 0.1
    assert_agrees(scene, backend)


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize("scale", [1e2, 1e6, 1e15, 1e30])
def test_huge_scales_do_not_overflow_the_tile_count(scale: float, backend: str) -> None:
    g = random_gaussians(12)._replace(scales=scale * torch.tensor([[0.7, 1.0, 2.0]]).repeat(12, 1))
    assert_agrees(Scene(g, camera(70, 50)), backend)


@pytest.mark.parametrize("backend", KERNELS)
def test_a_long_splat_far_outside_the_image_still_crosses_it(backend: str) -> None:
    # Its centre is 1e5 pixels away: the quadratic form of a float32 conic has no correct digit here.
    g = single_splat().gaussians._replace(
        means=torch.tensor([[800.0, 800.0, 1.0]]),
        quats=torch.tensor([[math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]]),
        scales=torch.tensor([[800.0, 0.02, 1e-4]]),
    )
    scene = replace(single_splat(), gaussians=g)
    assert render(scene).alpha.max() > 0.1
    assert_agrees(scene, backend, image_tolerance=1e-4)


@pytest.mark.parametrize("backend", KERNELS)
def test_too_many_pairs_are_refused_and_not_allocated(backend: str) -> None:
    g = random_gaussians(100_000, sh_degree=0)._replace(scales=torch.full((100_000, 3), 1e6))
    message = "drawing needs [0-9]+ pairs of a tile of .* and a splat, the limit is 67108864; are the scales too large"
    with pytest.raises(ValueError, match=message):
        render(Scene(g, camera(1100, 1100)), backend)


@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_non_finite_cotangent_shows_in_the_gradients_of_its_splat_alone(value: float, backend: str) -> None:
    one = single_splat(scale=0.01).gaussians
    places = torch.tensor([[-0.1, 0.0, 1.0], [0.1, 0.0, 1.0]])  # pixels 6.5 and 26.5 of a row
    g = Gaussians(*(torch.cat((field, field)) for field in one))._replace(means=places)
    cotangent = torch.ones(33, 33, 3)
    cotangent[16, 7] = value
    grads = gradients(replace(single_splat(), gaussians=g), backend, cotangent, None)
    for name in Gaussians._fields:
        assert not torch.isfinite(grads[name][0]).all() and torch.isfinite(grads[name][1]).all(), name


@pytest.mark.parametrize("backend", KERNELS)
def test_alpha_has_a_gradient(backend: str) -> None:
    scene = Scene(random_gaussians(50), camera(30, 20))
    grads = gradients(scene, backend, None, torch.ones(20, 30))
    for name in ("means", "quats", "scales", "opacities"):
        assert grads[name].norm() > 0
    assert (grads["sh"] == 0).all() and (grads["background"] == 0).all()


@pytest.mark.parametrize("backend", KERNELS)
def test_results_do_not_differ_from_run_to_run(backend: str) -> None:
    scene = Scene(random_gaussians(3000 if backend == "cpu" else 300), camera(100, 100))
    cotangent = torch.randn(100, 100, 3)
    first = gradients(scene, backend, cotangent, None)
    for _ in range(5 if backend == "cpu" else 1):
        again = gradients(scene, backend, cotangent, None)
        assert all(torch.equal(again[name], first[name]) for name in first)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_single_opaque_splat_does_not_vanish(backend: str) -> None:
    found = render(single_splat(opacity=1.0), backend)
    assert found.alpha[16, 16] == pytest.approx(0.999, abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_alpha_just_under_the_cut_off_is_skipped_and_at_it_drawn(backend: str) -> None:
    edge = np.float32(1 / 255)
    at = render(single_splat(opacity=float(edge)), backend).alpha
    assert at[16, 16] == pytest.approx(1 / 255, rel=1e-4) and (at > 0).sum() == 1
    below = render(single_splat(opacity=float(np.nextafter(edge, np.float32(0)))), backend).alpha
    assert torch.equal(below, torch.zeros(33, 33))


def test_covariance_path_and_quaternion_path_agree() -> None:
    scene = Scene(random_gaussians(20, anisotropy=1.5), camera(20, 15))
    image, _ = splat_by_loops(scene)  # by the 3D covariance matrix
    assert (render(scene).image.double() - torch.from_numpy(image)).abs().max() < 2e-6


@pytest.mark.parametrize("backend", BACKENDS)
def test_zero_quaternion_is_the_identity_without_gradient(backend: str) -> None:
    g = random_gaussians(30)
    zero, identity = torch.zeros(30, 4), torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(30, 4)
    scene = Scene(g._replace(quats=zero), camera(30, 30))
    found, expected = render(scene, backend), render(replace(scene, gaussians=g._replace(quats=identity)), backend)
    assert torch.equal(found.image, expected.image)
    assert torch.equal(gradients(scene, backend, torch.randn(30, 30, 3), None)["quats"], zero)


@pytest.mark.parametrize("backend", KERNELS)
def test_colours_of_1e30_are_drawn(backend: str) -> None:
    scene = single_splat(colour=1e30)
    found, expected = render(scene, backend), render(in_float64(scene), "reference")
    torch.testing.assert_close(found.image.double(), expected.image, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("backend", KERNELS)
def test_a_colour_that_overflows_is_named(backend: str) -> None:
    g = random_gaussians(9)
    sh = g.sh.clone()
    sh[7] = 3e38
    with pytest.raises(CannotDraw, match="sh gives splat 7 a colour beyond the range of float32"):
        render(Scene(g._replace(sh=sh, means=g.means * 0.1), camera(20, 20)), backend)
