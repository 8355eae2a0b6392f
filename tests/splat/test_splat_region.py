"""A drawing limited to a region is the whole drawing inside it and background outside."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from splat.scenes import (
    BACKENDS,
    GPU,
    SCENES,
    SIMD,
    Scene,
    camera,
    gradients,
    in_float64,
    random_gaussians,
    render,
    use_simd,
)
from splat.test_splat_reference import check_gradients

from avatar.splat import splat
from avatar.splat.options import Region

WIDTH, HEIGHT = 75, 70  # a tile's side divides neither
SCENE = Scene(random_gaussians(150, seed=21), camera(WIDTH, HEIGHT))
REGIONS = {
    "all": (slice(None), slice(None)),
    "rows": (slice(31, 34), slice(None)),
    "columns": (slice(None), slice(63, None)),
    "one tile": (slice(32, 64), slice(32, 64)),
    "odd": (slice(13, 57), slice(7, 41)),
    "inside a tile": (slice(35, 47), slice(38, 61)),
    "corner": (slice(60, 70), slice(70, 75)),
    "1x1": (slice(33, 34), slice(40, 41)),
}


def _cotangents() -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    return torch.randn(HEIGHT, WIDTH, 3, generator=g), torch.randn(HEIGHT, WIDTH, generator=g)


def _zero_outside(tensor: torch.Tensor, region: tuple[slice, slice]) -> torch.Tensor:
    inside = torch.zeros_like(tensor)
    inside[region] = tensor[region]
    return inside


def _wrong(scene: Scene, name: str, backend: str) -> list[str]:
    """What of a drawing limited to the region, values and gradients, is not as the whole drawing has it."""
    region = REGIONS[name]
    whole, part = render(scene, backend), render(scene.with_options(region=region), backend)
    outside = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    outside[region] = False
    is_right = {
        "image": torch.equal(part.image[region], whole.image[region]),
        "alpha": torch.equal(part.alpha[region], whole.alpha[region]),
        "image outside": torch.equal(part.image[outside], scene.background.expand(int(outside.sum()), 3)),
        "alpha outside": bool((part.alpha[outside] == 0).all()),
    }
    grad_image, grad_alpha = (t.to(scene.background) for t in _cotangents())
    found = gradients(scene.with_options(region=region), backend, grad_image, grad_alpha)
    expected = gradients(scene, backend, _zero_outside(grad_image, region), _zero_outside(grad_alpha, region))
    background = expected.pop("background") + grad_image[outside].sum(0)
    is_right["gradient of background"] = torch.allclose(found.pop("background"), background, rtol=1e-5, atol=1e-5)
    for field, wanted in expected.items():
        is_right[f"some gradient of {field}"] = bool((wanted != 0).any()) or name == "1x1"
        is_right[f"gradient of {field}"] = (
            torch.allclose(found[field], wanted, rtol=1e-10, atol=1e-10)
            if backend == "reference"
            else torch.equal(found[field], wanted)
        )
    return [what for what, right in is_right.items() if not right]


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("name", REGIONS)
def test_kernel(name: str, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    for threads in (1, 5):
        monkeypatch.setenv("AVATAR_THREADS", str(threads))
        assert _wrong(SCENE, name, "cpu") == []
        assert _wrong(SCENE.with_options(antialiased=True, alpha_min=0.0, t_min=0.0), name, "cpu") == []


@pytest.mark.parametrize("backend", GPU)
@pytest.mark.parametrize("name", REGIONS)
def test_gpu(name: str, backend: str) -> None:
    assert _wrong(SCENE, name, backend) == []


@pytest.mark.parametrize("backend", GPU)
def test_gpu_with_other_options(backend: str) -> None:
    assert _wrong(SCENE.with_options(antialiased=True, alpha_min=0.0, t_min=0.0), "odd", backend) == []


@pytest.mark.parametrize("name", REGIONS)
def test_reference(name: str) -> None:
    assert _wrong(in_float64(SCENE), name, "reference") == []


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_has_the_gradient_of_every_pixel_outside(backend: str) -> None:
    scene = Scene(random_gaussians(0), camera(WIDTH, HEIGHT), options={"region": REGIONS["odd"]})
    found = gradients(scene, backend, torch.ones(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH))["background"]
    assert torch.equal(found, torch.full((3,), float(WIDTH * HEIGHT)))


def test_splats_beside_the_region_are_not_projected_into_it() -> None:
    # The colour that overflows stands in the left half; a drawing of the right half never computes it.
    g = random_gaussians(2, spread=0.0, size=0.01)
    means, sh = torch.tensor([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]]), g.sh.clone()
    sh[0] = 3e38
    scene = Scene(g._replace(means=means, sh=sh, opacities=torch.ones(2)), camera(64, 64, yaw=0.0))
    right = render(scene.with_options(region=(slice(None), slice(36, None))))
    assert right.alpha[:, 36:].max() > 0.8
    with pytest.raises(ValueError, match="sh gives splat 0 a colour"):
        render(scene)


def test_gradcheck_of_the_reference() -> None:
    scene = Scene(random_gaussians(4, sh_degree=1, spread=0.1, size=0.1), camera(5, 4))
    assert render(scene.with_options(region=(slice(2, 3), slice(1, 4)))).alpha.max() > 0.1
    check_gradients(scene, block=2, sh_degree=1, region=Region(1, 2, 4, 3))


@pytest.mark.parametrize("name", ["head", "wide field of view", "needles", "1x1"])
def test_regions_of_other_scenes(name: str) -> None:
    scene = SCENES[name]
    height, width = scene.camera.height, scene.camera.width
    region = slice(height // 3, height // 2 + 1), slice(width // 4, 3 * width // 4 + 1)
    whole, part = render(scene), render(scene.with_options(region=region))
    assert torch.equal(part.image[region], whole.image[region])


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (3, r"region must be a pair of slices \(rows, columns\) or None, got 3"),
        ((slice(1), slice(1), slice(1)), "region must be a pair of slices"),
        ((slice(1), 4), "region must be a pair of slices"),
        ((slice(0.5, 2), slice(1)), r"the rows of region must be a slice of whole numbers, got slice\(0.5, 2, None\)"),
    ],
)
def test_wrong_types(region: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        splat(SCENE.gaussians, SCENE.camera, SCENE.background, region=region)


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ((slice(0, 71), slice(None)), "the rows of region must be one or more within 0 to 70, got 0 to 71"),
        ((slice(None), slice(-1, 5)), "the columns of region must be one or more within 0 to 75, got -1 to 5"),
        ((slice(5, 5), slice(None)), "the rows of region must be one or more within 0 to 70, got 5 to 5"),
        ((slice(None), slice(9, 2)), "the columns of region must be one or more within 0 to 75, got 9 to 2"),
        ((slice(None, None, 2), slice(None)), r"the rows of region must be consecutive, got slice\(None, None, 2\)"),
    ],
)
def test_regions_out_of_the_image(region: Any, message: str) -> None:
    for backend in ("cpu", "reference"):
        with pytest.raises(ValueError, match=message):
            render(replace(SCENE, options={"region": region}), backend)
