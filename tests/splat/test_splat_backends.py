"""The same assertions over every backend and every instruction set of the kernel."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat.loops import splat_by_loops
from splat.scenes import (
    BACKENDS,
    GPU,
    SCENES,
    SIMD,
    Scene,
    assert_agrees,
    assert_gradients_close,
    camera,
    expected_of_named,
    gradients,
    in_float64,
    random_gaussians,
    render,
    use_simd,
)

from avatar.compute.device import interpreted
from avatar.types import Gaussians

SMALL = {
    "random": Scene(random_gaussians(25), camera(17, 13)),
    "off-centre, anisotropic": Scene(random_gaussians(20, seed=1, anisotropy=1.5), camera(14, 18, centre=(-0.2, 0.9))),
    "opaque": Scene(random_gaussians(40, seed=2)._replace(opacities=torch.ones(40)), camera(12, 12)),
    "beyond the Jacobian's clamp": Scene(
        random_gaussians(40, seed=3, spread=1.0, size=0.2), replace(camera(16, 12), fx=6.0, fy=5.0)
    ),
    "antialiased": Scene(random_gaussians(60, seed=4, size=0.01), camera(15, 15), options={"antialiased": True}),
    "cut-offs": Scene(
        random_gaussians(40, seed=5),
        camera(16, 16),
        options={"alpha_min": 0.03, "alpha_max": 0.7, "t_min": 0.1, "blur": 0.8, "sh_degree": 1},
    ),
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", SMALL)
def test_image_and_alpha_are_those_of_the_definition_written_as_loops(name: str, backend: str) -> None:
    scene = in_float64(SMALL[name]) if backend == "reference" else SMALL[name]
    image, alpha = splat_by_loops(scene)
    found = render(scene, backend)
    tolerance = 1e-10 if backend == "reference" else 2e-6
    assert (found.image.double() - torch.from_numpy(image)).abs().max() < tolerance
    assert (found.alpha.double() - torch.from_numpy(alpha)).abs().max() < tolerance


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("name", SCENES)
def test_kernel_agrees_with_the_reference(name: str, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    assert_agrees(SCENES[name], expected=expected_of_named(name))


# The interpreter would take half a minute for the head's 14,876 splats.
@pytest.mark.parametrize("backend", GPU)
@pytest.mark.parametrize("name", [name for name in SCENES if name != "head" or not interpreted()])
def test_gpu_kernels_agree_with_the_reference(name: str, backend: str) -> None:
    assert_agrees(SCENES[name], backend, expected=expected_of_named(name))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")
@pytest.mark.parametrize("name", ["random", "thresholds", "antialiased", "no cut-offs"])
def test_reference_on_a_gpu_agrees_with_itself_on_the_cpu(name: str) -> None:
    scene, expected = SCENES[name], expected_of_named(name)
    gaussians = Gaussians(*(t.cuda() for t in scene.gaussians))
    on_gpu = in_float64(replace(scene, gaussians=gaussians, background=scene.background.cuda()))
    found = render(on_gpu, "reference")
    assert ((found.image.cpu() - expected.rendering.image).abs().amax(-1) <= 1e-10 + expected.jump).all()
    cotangents = (t.double().cuda() for t in (expected.grad_image, expected.grad_alpha))
    on_cpu = {name: grad.cpu() for name, grad in gradients(on_gpu, "reference", *cotangents).items()}
    assert_gradients_close(on_cpu, expected.gradients, 1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", ["none", "all behind the camera", "all transparent", "all beside the image"])
def test_without_a_visible_splat_the_background_is_drawn(which: str, backend: str) -> None:
    g = random_gaussians(0 if which == "none" else 50)
    if which == "all behind the camera":
        g = g._replace(means=g.means - torch.tensor([0.0, 0.0, 10.0]))
    if which == "all transparent":
        g = g._replace(opacities=torch.full((50,), 0.0039))
    if which == "all beside the image":
        g = g._replace(means=g.means + torch.tensor([20.0, 0.0, 0.0]))
    scene = Scene(g, camera(35, 20, yaw=0.0))
    found = render(scene, backend)
    assert torch.equal(found.image, scene.background.expand(20, 35, 3))
    assert torch.equal(found.alpha, torch.zeros(20, 35))
    grads = gradients(scene, backend, torch.ones(20, 35, 3), torch.ones(20, 35))
    assert torch.equal(grads.pop("background"), torch.full((3,), 700.0))
    assert all(torch.equal(grad, torch.zeros_like(grad)) for grad in grads.values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_depths_are_drawn_in_the_order_of_the_index(backend: str) -> None:
    g = random_gaussians(40, spread=0.05, size=0.05)
    g = g._replace(means=g.means * torch.tensor([1.0, 1.0, 0.0]), opacities=torch.full((40,), 0.7))
    scene = Scene(g, camera(24, 24, yaw=0.0))
    in_order = render(scene, backend)
    deeper = g.means + torch.tensor([0.0, 0.0, 1e-5]) * torch.arange(40.0)[:, None]
    apart = render(replace(scene, gaussians=g._replace(means=deeper)), backend)
    assert (in_order.image - apart.image).abs().max() < 1e-2
    flipped = render(replace(scene, gaussians=Gaussians(*(f.flip(0) for f in g))), backend)
    assert (in_order.image - flipped.image).abs().max() > 0.1


@pytest.mark.parametrize("backend", BACKENDS)
def test_depths_that_only_float64_tells_apart_are_still_in_order(backend: str) -> None:
    g = random_gaussians(2, size=0.1)._replace(opacities=torch.full((2,), 0.9))
    # Depths 1.2 + 2^-26 and 1.2: one float32, two doubles. The second is in front although its index is higher.
    means = torch.tensor([[0.0, 0.0, 2.0**-26], [0.0, 0.0, 0.0]])
    scene = Scene(g._replace(means=means), camera(9, 9, yaw=0.0))
    front = render(replace(scene, gaussians=Gaussians(*(f[1:] for f in scene.gaussians))), backend)
    both = render(scene, backend)
    assert (both.image - front.image)[4, 4].abs().max() < 0.1 * (1 + front.image[4, 4].abs().max())
    assert_agrees(scene)


@pytest.mark.parametrize("backend", BACKENDS)
def test_coefficients_above_the_degree_get_zero_gradient(backend: str) -> None:
    scene = Scene(random_gaussians(30), camera(20, 20), options={"sh_degree": 1})
    grad = gradients(scene, backend, torch.randn(20, 20, 3), None)["sh"]
    assert (grad[:, :4] != 0).any()
    assert torch.equal(grad[:, 4:], torch.zeros(30, 12, 3))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("output", ["image", "alpha"])
def test_each_output_has_its_own_gradient(output: str, backend: str) -> None:
    scene = Scene(random_gaussians(30), camera(20, 20))
    grad_image = torch.randn(20, 20, 3) if output == "image" else None
    grad_alpha = torch.randn(20, 20) if output == "alpha" else None
    alone = gradients(scene, backend, grad_image, grad_alpha)
    beside_zeros = gradients(
        scene,
        backend,
        torch.zeros(20, 20, 3) if grad_image is None else grad_image,
        torch.zeros(20, 20) if grad_alpha is None else grad_alpha,
    )
    assert (alone["opacities"] != 0).any()
    assert all(torch.equal(alone[name], beside_zeros[name]) for name in alone)
