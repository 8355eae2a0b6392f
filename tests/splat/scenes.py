"""Scenes for the tests of the splatter, and the assertions that every backend has to meet on them."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from avatar.compute.device import interpreted
from avatar.splat import check_options, splat
from avatar.splat.options import Options, check_region
from avatar.splat.scenes import head_camera, head_shell
from avatar.types import Camera, Gaussians, Rendering

SIMD = ("baseline", "avx2", "avx512")
# The gpu backend takes part where there is a GPU, and where Triton interprets its kernels: make gpu-check.
GPU = ["gpu"] if interpreted() or torch.cuda.is_available() else []
BACKENDS = ["cpu", "reference", *GPU]
POSE = ("R_cam_world", "t_cam_world")


@dataclass(frozen=True)
class Scene:
    gaussians: Gaussians
    camera: Camera
    background: Tensor = field(default_factory=lambda: torch.tensor([0.2, 0.5, 0.9]))
    options: dict[str, Any] = field(default_factory=dict)

    def with_options(self, **options: Any) -> Scene:
        return replace(self, options={**self.options, **options})


def use_simd(monkeypatch: pytest.MonkeyPatch, simd: str) -> None:
    """Make the cpu backend use one instruction set; skip the test where the processor does not have it."""
    monkeypatch.setenv("AVATAR_SIMD", simd)
    try:
        render(Scene(random_gaussians(1), camera(1, 1)))
    except ValueError as error:
        if "does not have" not in str(error):
            raise
        pytest.skip(f"this processor does not have {simd}")


def camera(width: int, height: int, *, centre: tuple[float, float] | None = None, yaw: float = 0.3) -> Camera:
    """A camera 1.2 m in front of the origin, turned by `yaw`; `centre` is the principal point as a part of the size."""
    cx, cy = centre if centre is not None else (0.5, 0.5)
    c, s = math.cos(yaw), math.sin(yaw)
    R = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    side = max(width, height)
    return Camera(R, torch.tensor([0.03, -0.02, 1.2]), 1.3 * side, 1.4 * side, cx * width, cy * height, width, height)


def random_gaussians(
    count: int, *, seed: int = 0, sh_degree: int = 3, spread: float = 0.3, size: float = 0.03, anisotropy: float = 0.8
) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=spread * torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        scales=size * torch.exp(anisotropy * torch.randn(count, 3, generator=g)),
        opacities=torch.rand(count, generator=g),
        sh=0.3 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=g),
    )


def single_splat(*, opacity: float = 0.8, scale: float = 0.02, depth: float = 1.0, colour: float = 0.3) -> Scene:
    """One round splat on the axis of an unturned camera of 33 x 33 pixels, whose middle pixel's centre it hits."""
    return Scene(
        Gaussians(
            torch.tensor([[0.0, 0.0, depth]]),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            torch.full((1, 3), scale),
            torch.tensor([opacity]),
            torch.full((1, 1, 3), (colour - 0.5) / math.sqrt(1 / (4 * math.pi))),
        ),
        Camera(torch.eye(3), torch.zeros(3), 100.0, 100.0, 16.5, 16.5, 33, 33),
    )


def threshold_gaussians() -> Gaussians:
    """Opacities at and around every cut-off: 0, 1/255, alpha_max, 1; all splats on pixel centres or near them."""
    steps = [0.0, 1e-30, 1e-7]
    for edge in (np.float32(1 / 255), np.float32(0.999), np.float32(1.0)):
        steps += [float(np.nextafter(edge, np.float32(0))), float(edge), float(min(1.0, edge * np.float32(1.001)))]
    g = random_gaussians(len(steps) * 12, seed=4, spread=0.25, size=0.02)
    return g._replace(opacities=torch.tensor(steps).repeat(12))


SCENES: dict[str, Scene] = {
    "random": Scene(random_gaussians(400), camera(250, 131)),
    "head": Scene(head_shell(), head_camera(256), torch.ones(3)),
    "anisotropic": Scene(random_gaussians(150, seed=1, anisotropy=2.0), camera(120, 90)),
    "off-centre": Scene(random_gaussians(200, seed=2), camera(100, 70, centre=(0.2, 0.85))),
    "centre outside the image": Scene(random_gaussians(300, seed=3), camera(90, 90, centre=(-0.4, 1.3))),
    "wide field of view": Scene(
        random_gaussians(200, seed=5, spread=0.8), replace(camera(96, 64), fx=25.0, fy=22.0, cx=50.0)
    ),
    "1x1": Scene(random_gaussians(30, seed=6), camera(1, 1)),
    "17x33": Scene(random_gaussians(60, seed=7), camera(17, 33)),
    "32x32": Scene(random_gaussians(60, seed=8), camera(32, 32)),
    "33x65": Scene(random_gaussians(60, seed=18), camera(33, 65)),
    "opaque": Scene(random_gaussians(150, seed=9)._replace(opacities=torch.ones(150)), camera(64, 48)),
    # Every pixel is full long before its list of splats ends.
    "walls": Scene(
        random_gaussians(150, seed=19, spread=0.03, size=0.3)._replace(opacities=torch.ones(150)), camera(20, 20)
    ),
    "dense": Scene(random_gaussians(3000, seed=10, spread=0.08), camera(40, 40)),
    "thresholds": Scene(threshold_gaussians(), camera(80, 60)),
    "one": Scene(random_gaussians(1, seed=11, spread=0.01), camera(31, 29)),
    "single on a pixel centre": single_splat(),
    "antialiased": Scene(random_gaussians(400, seed=12, size=0.004), camera(96, 96), options={"antialiased": True}),
    "needles": Scene(
        random_gaussians(60, seed=13)._replace(scales=torch.tensor([[0.5, 1e-4, 1e-6]]).repeat(60, 1)), camera(128, 128)
    ),
    "unnormalised quaternions": Scene(
        (g := random_gaussians(100, seed=14))._replace(quats=g.quats * torch.logspace(-18, 15, 100)[:, None]),
        camera(64, 64),
    ),
    "no cut-offs": Scene(random_gaussians(60, seed=15), camera(40, 30), options={"alpha_min": 0.0, "t_min": 0.0}),
    "other cut-offs": Scene(
        random_gaussians(300, seed=16),
        camera(64, 64),
        options={"alpha_min": 0.05, "alpha_max": 0.6, "t_min": 0.2, "blur": 1.5, "near": 1.1},
    ),
    **{
        f"degree {used} of {stored}": Scene(
            random_gaussians(80, seed=17, sh_degree=stored), camera(50, 40), options={"sh_degree": used}
        )
        for stored in range(4)
        for used in range(stored + 1)
    },
}


def checked_options(scene: Scene, backend: str) -> Options:
    """As `splat` gives them to a backend."""
    given = {**(inspect.unwrap(splat).__kwdefaults__ or {}), **scene.options}
    del given["backend"]
    given["region"] = check_region(given["region"], scene.camera.width, scene.camera.height)
    return check_options(scene.gaussians, scene.camera, scene.background, backend, Options(**given))


def render(scene: Scene, backend: Any = "cpu") -> Rendering:
    """On whatever device the scene is; drawn by a GPU, the rendering of a scene on the CPU comes back to it."""
    if backend == "gpu" and not interpreted() and scene.background.is_cpu:
        gaussians = Gaussians(*(tensor.cuda() for tensor in scene.gaussians))
        moved = replace(scene, gaussians=gaussians, background=scene.background.cuda())
        return Rendering(*(tensor.cpu() for tensor in render(moved, backend)))
    return splat(scene.gaussians, scene.camera, scene.background, backend=backend, **scene.options)


def gradients(scene: Scene, backend: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> dict[str, Tensor]:
    """dL/d(every input) for L = grad_image . image + grad_alpha . alpha."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs_of(scene).items()}
    rendering = render(with_inputs(scene, leaves), backend)
    pairs = [(o, g) for o, g in zip(rendering, (grad_image, grad_alpha), strict=True) if g is not None]
    outputs, cotangents = zip(*pairs, strict=True)
    found = torch.autograd.grad(outputs, list(leaves.values()), cotangents, allow_unused=True)
    return {n: torch.zeros_like(leaves[n]) if g is None else g for n, g in zip(leaves, found, strict=True)}


def inputs_of(scene: Scene) -> dict[str, Tensor]:
    """All that a drawing has a gradient in."""
    pose = {name: getattr(scene.camera, name) for name in POSE}
    return {**scene.gaussians._asdict(), "background": scene.background, **pose}


def with_inputs(scene: Scene, inputs: dict[str, Tensor]) -> Scene:
    """The scene with other tensors in the place of `inputs_of` it."""
    gaussians, pose = Gaussians(*(inputs[n] for n in Gaussians._fields)), {name: inputs[name] for name in POSE}
    return replace(scene, gaussians=gaussians, background=inputs["background"], camera=replace(scene.camera, **pose))


def in_float64(scene: Scene) -> Scene:
    return with_inputs(scene, {name: tensor.double() for name, tensor in inputs_of(scene).items()})


def ambiguous_pixels(scene: Scene) -> tuple[Tensor, Tensor]:
    """Pixels where a cut-off is met to within float32 rounding, and by how much the image jumps there.

    The cut-offs make the image a discontinuous function: where an alpha equals alpha_min, or a transmittance t_min, to
    seven digits, a float32 kernel may rightly decide either way. Such pixels are found by moving the cut-offs by 1e-5.
    """
    bounds = []
    for factor in (1 - 1e-5, 1 + 1e-5):
        alpha_min = scene.options.get("alpha_min", 1 / 255) * factor
        t_min = scene.options.get("t_min", 1e-4) * factor
        with torch.no_grad():
            bounds.append(render(in_float64(scene.with_options(alpha_min=alpha_min, t_min=t_min)), "reference"))
    jump = (bounds[0].image - bounds[1].image).abs().amax(-1)
    jump = torch.maximum(jump, (bounds[0].alpha - bounds[1].alpha).abs())
    return jump > 1e-6, jump


@dataclass(frozen=True)
class Expected:
    """What the float64 reference says of a scene, and one random cotangent, zero at ambiguous pixels."""

    rendering: Rendering
    ambiguous: Tensor  # bool [H, W]
    jump: Tensor  # [H, W]
    grad_image: Tensor
    grad_alpha: Tensor
    gradients: dict[str, Tensor]


def expected_of(scene: Scene) -> Expected:
    ambiguous, jump = ambiguous_pixels(scene)
    with torch.no_grad():
        rendering = render(in_float64(scene), "reference")
    g = torch.Generator().manual_seed(99)
    grad_image = torch.randn(rendering.image.shape, generator=g).masked_fill(ambiguous[..., None], 0.0)
    grad_alpha = torch.randn(rendering.alpha.shape, generator=g).masked_fill(ambiguous, 0.0)
    wanted = gradients(in_float64(scene), "reference", grad_image.double(), grad_alpha.double())
    return Expected(rendering, ambiguous, jump, grad_image, grad_alpha, wanted)


@cache
def expected_of_named(name: str) -> Expected:
    return expected_of(SCENES[name])


def assert_agrees(
    scene: Scene,
    backend: Any = "cpu",
    *,
    expected: Expected | None = None,
    image_tolerance: float = 1e-5,
    pose_tolerance: float = 1e-4,
) -> None:
    """Image, alpha and, for one random cotangent, every gradient agree with the float64 reference."""
    if expected is None:
        expected = expected_of(scene)
    assert expected.ambiguous.float().mean() <= 0.01 or expected.ambiguous.sum() <= 2
    with torch.no_grad():
        drawn = render(scene, backend)
    allowed = image_tolerance + torch.where(expected.ambiguous, expected.jump, 0.0)
    assert ((drawn.image - expected.rendering.image).abs().amax(-1) <= allowed).all()
    assert ((drawn.alpha - expected.rendering.alpha).abs() <= allowed).all()
    found, wanted = gradients(scene, backend, expected.grad_image, expected.grad_alpha), dict(expected.gradients)
    assert_gradients_close(found, {name: wanted.pop(name) for name in POSE}, pose_tolerance)
    assert_gradients_close(found, wanted)


def assert_gradients_close(found: dict[str, Tensor], wanted: dict[str, Tensor], tolerance: float = 1e-4) -> None:
    """Each tensor as a whole to `tolerance`, each element to 10 * tolerance of itself plus `tolerance` of the RMS.

    Values below 1e-36 may be lost: float32 ends there.
    """
    for name, expected in wanted.items():
        error = found[name].double() - expected
        assert torch.isfinite(found[name]).all(), name
        assert error.norm() <= tolerance * expected.norm() + 1e-36, f"{name}: {error.norm() / expected.norm():.1e}"
        rms = expected.norm() / max(expected.numel(), 1) ** 0.5
        worst = (
            (error.abs() - 10 * tolerance * expected.abs() - tolerance * rms - 1e-36).max() if error.numel() else 0.0
        )
        assert worst <= 0, f"{name}: an element is off by {worst:.1e} more than allowed (RMS {rms:.1e})"
