"""Features in place of colours: any number of channels, on every backend."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from interpreter import DEVICE
from splat.features import FIELDS, cotangents, draw, everything, with_features
from splat.scenes import (
    BACKENDS,
    GPU,
    POSE,
    SCENES,
    SIMD,
    Scene,
    ambiguous_pixels,
    assert_gradients_close,
    camera,
    gradients,
    random_gaussians,
    render,
    single_splat,
    use_simd,
)
from splat.test_splat_reference import options_of
from torch import Tensor

from avatar.splat import checked_drawings
from avatar.splat.reference import splat_reference
from avatar.splat.sh import C0
from avatar.types import FeatureGaussians, Rendering

CHANNELS = [1, 3, 5, 8, 32, 33]
SMALL = Scene(random_gaussians(40, seed=3), camera(19, 35, centre=(0.3, 0.6)))


@cache
def expected(name: str, channels: int) -> tuple[Rendering, dict[str, Tensor], Tensor, Tensor]:
    """What the float64 reference says, for cotangents that are zero where float64 itself sits on a cut-off."""
    scene, ambiguous = SCENES[name], ambiguous_pixels(SCENES[name])[0]
    by_image, by_alpha = cotangents(scene, channels)
    by_image, by_alpha = by_image.masked_fill(ambiguous[..., None], 0.0), by_alpha.masked_fill(ambiguous, 0.0)
    inputs = {name: tensor.double() for name, tensor in with_features(scene, channels).items()}
    return *everything(scene, inputs, "reference", by_image, by_alpha), by_image, by_alpha


def assert_agrees(name: str, channels: int, backend: str) -> None:
    scene = SCENES[name]
    drawn, wanted, by_image, by_alpha = expected(name, channels)
    found, found_gradients = everything(scene, with_features(scene, channels), backend, by_image, by_alpha)
    clear = ~ambiguous_pixels(scene)[0]
    assert clear.float().mean() > 0.98
    assert (found.image - drawn.image)[clear].abs().max() < 1e-5
    assert (found.alpha - drawn.alpha)[clear].abs().max() < 1e-5
    assert_gradients_close(found_gradients, wanted)


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("channels", CHANNELS)
def test_kernel_agrees_with_the_reference(channels: int, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    assert_agrees("33x65", channels, "cpu")


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("name", ["walls", "opaque", "dense", "other cut-offs", "antialiased", "no cut-offs", "1x1"])
def test_kernel_agrees_with_the_reference_on_other_scenes(
    name: str, simd: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_simd(monkeypatch, simd)
    assert_agrees(name, 5, "cpu")


@pytest.mark.parametrize("backend", GPU)
@pytest.mark.parametrize("channels", CHANNELS)
def test_gpu_kernels_agree_with_the_reference(channels: int, backend: str) -> None:
    assert_agrees("17x33", channels, backend)


@pytest.mark.parametrize("backend", GPU)
@pytest.mark.parametrize("name", ["walls", "other cut-offs", "antialiased", "no cut-offs", "1x1"])
def test_gpu_kernels_agree_with_the_reference_on_other_scenes(name: str, backend: str) -> None:
    assert_agrees(name, 5, backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("channels", CHANNELS)
def test_image_and_gradients_are_those_of_three_channels_at_a_time(channels: int, backend: str) -> None:
    scene, inputs = SMALL, with_features(SMALL, channels, positive=True)
    by_image, by_alpha = cotangents(scene, channels)
    found, found_gradients = everything(scene, inputs, backend, by_image, by_alpha)
    passes = -(-channels // 3)
    padding = (0, 3 * passes - channels)
    features, background, by_colour = (
        torch.nn.functional.pad(t, padding) for t in (inputs["features"], inputs["background"], by_image)
    )
    total: dict[str, Tensor] = {}
    for k in range(passes):
        part = slice(3 * k, 3 * k + 3)
        colours = Scene(
            scene.gaussians._replace(sh=((features[:, part] - 0.5) / C0)[:, None]), scene.camera, background[part]
        )
        one, shown = render(colours, backend), 3 if k < passes - 1 else 3 - padding[1]
        assert torch.equal(one.alpha, found.alpha) or backend == "gpu"
        assert (one.image[..., :shown] - found.image[..., part]).abs().max() < 1e-6
        by_pass = gradients(colours, backend, by_colour[..., part].contiguous(), by_alpha if k == 0 else None)
        by_pass["features"] = by_pass.pop("sh")[:, 0] / C0
        for name in ("features", "background"):
            assert_gradients_close({name: found_gradients[name][..., part]}, {name: by_pass[name][..., :shown]}, 1e-6)
        for name in FIELDS[:4]:
            total[name] = total.get(name, 0) + by_pass[name]
    assert_gradients_close(found_gradients, total, 1e-5)


def test_three_channels_are_those_of_splat_to_the_bit() -> None:
    scene = SCENES["random"]
    colours = scene.with_options(sh_degree=0)
    inputs = with_features(scene, 3) | {"background": scene.background}
    # The colour as the kernel adds it up, in float32.
    basis = torch.tensor(C0)
    inputs["features"] = (0.5 + basis * scene.gaussians.sh[:, 0]).clamp(min=0)
    found, drawn = draw(scene, inputs, "cpu"), render(colours)
    assert torch.equal(found.image, drawn.image) and torch.equal(found.alpha, drawn.alpha)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_of_the_reference(antialiased: bool) -> None:
    g = random_gaussians(5, spread=0.1, size=0.1)
    g.means[4, 2] -= 2.0  # behind the camera
    scene = Scene(g, camera(4, 3, centre=(0.3, 0.8)))
    inputs = {name: tensor.double() for name, tensor in with_features(scene, 4).items()}
    options = options_of(scene, antialiased=antialiased, sh_degree=None)

    def drawing(*values: Tensor) -> tuple[Tensor, ...]:
        named = dict(zip(inputs, values, strict=True))
        view = replace(scene.camera, **{name: named[name] for name in POSE})
        return tuple(splat_reference(FeatureGaussians(*values[:5]), view, named["background"], options))

    leaves = [tensor.requires_grad_() for tensor in inputs.values()]
    assert torch.autograd.gradcheck(drawing, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("simd", SIMD)
@pytest.mark.parametrize("channels", [3, 33])
def test_threads_1_2_and_5_agree_to_the_bit(channels: int, simd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_simd(monkeypatch, simd)
    scene = SCENES["random"]
    found = {}
    for threads in (1, 2, 5):
        monkeypatch.setenv("AVATAR_THREADS", str(threads))
        drawn, by_name = everything(scene, with_features(scene, channels), "cpu", *cotangents(scene, channels))
        found[threads] = [*drawn, *by_name.values()]
    for threads in (2, 5):
        assert all(torch.equal(a, b) for a, b in zip(found[threads], found[1], strict=True))


@pytest.mark.parametrize("channels", [1, 5])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_region_is_the_whole_drawing_inside_and_background_outside(backend: str, channels: int) -> None:
    region = slice(5, 34), slice(3, 12)
    inputs, (by_image, by_alpha) = with_features(SMALL, channels), cotangents(SMALL, channels)
    inside = torch.zeros(by_alpha.shape, dtype=torch.bool)
    inside[region] = True
    part, found = everything(SMALL.with_options(region=region), inputs, backend, by_image, by_alpha)
    cut = by_image * inside[..., None], by_alpha * inside
    whole, wanted = everything(SMALL, inputs, backend, *cut)
    assert torch.equal(part.image[region], whole.image[region])
    assert torch.equal(part.alpha[region], whole.alpha[region])
    assert torch.equal(part.image[~inside], inputs["background"].expand(int((~inside).sum()), channels))
    assert not part.alpha[~inside].any()
    wanted["background"] = wanted["background"] + by_image[~inside].sum(0)
    assert_gradients_close(found, wanted, 1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", ["none", "all behind the camera"])
def test_without_a_visible_splat_the_background_is_drawn(which: str, backend: str) -> None:
    g = random_gaussians(0 if which == "none" else 20)
    scene = Scene(g._replace(means=g.means - torch.tensor([0.0, 0.0, 10.0])), camera(35, 20, yaw=0.0))
    inputs = with_features(scene, 5)
    drawn, by_name = everything(scene, inputs, backend, torch.ones(20, 35, 5), torch.ones(20, 35))
    assert torch.equal(drawn.image, inputs["background"].expand(20, 35, 5))
    assert torch.equal(drawn.alpha, torch.zeros(20, 35))
    assert torch.equal(by_name.pop("background"), torch.full((5,), 700.0))
    assert all(torch.equal(grad, torch.zeros_like(grad)) for grad in by_name.values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_features_are_not_clamped(backend: str) -> None:
    scene = single_splat(opacity=0.5)
    inputs = with_features(scene, 2)
    inputs |= {"features": torch.tensor([[-4.0, 1000.0]]), "background": torch.zeros(2)}
    middle = draw(scene, inputs, backend).image[16, 16]
    assert torch.allclose(middle, torch.tensor([-2.0, 500.0]), rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("output", ["image", "alpha"])
def test_each_output_has_its_own_gradient(output: str, backend: str) -> None:
    inputs, (by_image, by_alpha) = with_features(SMALL, 5), cotangents(SMALL, 5)
    only = (by_image, None) if output == "image" else (None, by_alpha)
    beside_zeros = [torch.zeros_like(g) if o is None else o for o, g in zip(only, (by_image, by_alpha), strict=True)]
    _, alone = everything(SMALL, inputs, backend, *only)
    _, wanted = everything(SMALL, inputs, backend, *beside_zeros)
    assert (alone["opacities"] != 0).any()
    assert bool(alone["features"].any()) == (output == "image")
    if backend == "gpu" and DEVICE.type == "cuda":  # whose compiler may order one kernel's products differently
        assert_gradients_close(alone, wanted, 1e-6)
    else:
        assert all(torch.equal(alone[name], wanted[name]) for name in alone)


def test_strided_features_and_cotangents_are_read_as_what_they_show() -> None:
    inputs, (by_image, by_alpha) = with_features(SMALL, 5), cotangents(SMALL, 5)
    wanted = everything(SMALL, inputs, "cpu", by_image, by_alpha)[1]
    strided = {**inputs, "features": inputs["features"].T.contiguous().T}
    turned = by_image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided["features"].is_contiguous() and not turned.is_contiguous()
    found = everything(SMALL, strided, "cpu", turned, by_alpha)[1]
    assert all(torch.equal(found[name], wanted[name]) for name in wanted)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("name", ["scales", "features", "background"])
def test_non_finite_values_are_named_counted_and_located(name: str, value: float, backend: str) -> None:
    inputs = with_features(SMALL, 5)
    inputs[name] = inputs[name].clone()
    inputs[name].view(-1)[-1] = value
    message = rf"{name} has 1 non-finite of {inputs[name].numel()} values, the first at"
    with checked_drawings(), pytest.raises(ValueError, match=message):
        draw(SMALL, inputs, backend)


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("features", (40,), r"features must have shape \[N, C\], got \[40\]"),
        ("features", (40, 1, 5), r"features must have shape \[N, C\], got \[40, 1, 5\]"),
        ("features", (39, 5), "features has N = 39, but means has N = 40"),
        ("features", (40, 0), r"background has C = 5, but features has C = 0"),
        ("background", (3,), "background has C = 3, but features has C = 5"),
        ("background", (5, 1), r"background must have shape \[C\], got \[5, 1\]"),
    ],
)
def test_wrong_shapes(name: str, shape: tuple[int, ...], message: str, backend: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(SMALL, {**with_features(SMALL, 5), name: torch.zeros(shape)}, backend)


def test_no_channels_are_refused() -> None:
    with pytest.raises(ValueError, match=r"features must have one channel or more, got \[40, 0\]"):
        draw(SMALL, with_features(SMALL, 0), "cpu")


def test_wrong_types() -> None:
    with pytest.raises(TypeError, match='features must be float32 for backend "cpu", got torch.float64'):
        draw(SMALL, {**with_features(SMALL, 5), "features": torch.zeros(40, 5).double()}, "cpu")
    with pytest.raises(ValueError, match="alpha_min must be in"):
        draw(SMALL.with_options(alpha_min=2.0), with_features(SMALL, 5), "cpu")
