"""Wrong arguments are named in one sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat.scenes import BACKENDS, POSE, Scene, camera, random_gaussians, render

from avatar.splat import _check_camera
from avatar.types import Gaussians

SCENE = Scene(random_gaussians(10), camera(20, 20))


def _with_field(name: str, value: torch.Tensor) -> Scene:
    if name == "background":
        return replace(SCENE, background=value)
    return replace(SCENE, gaussians=SCENE.gaussians._replace(**{name: value}))


def _field(name: str) -> torch.Tensor:
    return SCENE.background if name == "background" else getattr(SCENE.gaussians, name)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", [*Gaussians._fields, "background"])
def test_non_finite_values_are_named_counted_and_located(name: str, value: float, backend: str) -> None:
    tensor = _field(name).clone()
    tensor.view(-1)[-1] = value
    last = [size - 1 for size in tensor.shape]
    message = rf"{name} has 1 non-finite of {tensor.numel()} values, the first at \[{', '.join(map(str, last))}\]"
    with pytest.raises(ValueError, match=message):
        render(_with_field(name, tensor), backend)


def test_a_non_finite_value_of_a_hidden_splat_is_named_too() -> None:
    opacities = SCENE.gaussians.opacities.clone()
    opacities[3] = 0.0
    sh = SCENE.gaussians.sh.clone()
    sh[3, 2, 1] = torch.nan
    with pytest.raises(ValueError, match=r"sh has 1 non-finite of 480 values, the first at \[3, 2, 1\]"):
        render(replace(SCENE, gaussians=SCENE.gaussians._replace(opacities=opacities, sh=sh)))


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("means", (10, 2), r"means must have shape \[N, 3\], got \[10, 2\]"),
        ("quats", (10, 3), r"quats must have shape \[N, 4\], got \[10, 3\]"),
        ("scales", (9, 3), r"scales has N = 9, but means has N = 10"),
        ("opacities", (10, 1), r"opacities must have shape \[N\], got \[10, 1\]"),
        ("sh", (10, 3), r"sh must have shape \[N, K, 3\], got \[10, 3\]"),
        ("sh", (10, 5, 3), r"sh must have 1, 4, 9 or 16 coefficients a channel .* got 5"),
        ("background", (4,), r"background must have shape \[3\], got \[4\]"),
    ],
)
def test_wrong_shapes(name: str, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render(_with_field(name, torch.zeros(shape)))


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("name", [*Gaussians._fields, "background"])
def test_wrong_types(name: str) -> None:
    with pytest.raises(TypeError, match=f'{name} must be float32 for backend "cpu", got torch.float64'):
        render(_with_field(name, _field(name).double()))
    with pytest.raises(TypeError, match=f'{name} must be float32 or float64 for backend "reference", got torch.int64'):
        render(_with_field(name, _field(name).long()), "reference")


def test_wrong_device() -> None:
    with pytest.raises(ValueError, match='scales must be on cpu for backend "cpu", got meta'):
        render(_with_field("scales", SCENE.gaussians.scales.to("meta")))


@pytest.mark.parametrize("name", POSE)
def test_a_pose_that_is_elsewhere(name: str) -> None:
    pose = getattr(SCENE.camera, name).to("meta")
    with pytest.raises(ValueError, match=rf"camera\.{name} must be on the cpu .* got meta"):
        render(replace(SCENE, camera=replace(SCENE.camera, **{name: pose})))


def test_unknown_backend() -> None:
    with pytest.raises(ValueError, match='backend must be "cpu", "gpu" or "reference", got \'metal\''):
        render(SCENE, "metal")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("alpha_min", -0.1),
        ("alpha_min", 1.0),
        ("alpha_min", torch.nan),
        ("alpha_max", 0.0),
        ("alpha_max", 1.0),
        ("t_min", -1e-9),
        ("t_min", 1.0),
        ("blur", -0.3),
        ("blur", torch.inf),
        ("near", 0.0),
        ("near", torch.nan),
        ("sh_degree", 4),
        ("sh_degree", -1),
    ],
)
def test_options_out_of_range(option: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{option} must be .* got {value}"):
        render(SCENE.with_options(**{option: value}))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("fx", 0.0),
        ("fy", -5.0),
        ("fx", torch.nan),
        ("cx", torch.inf),
        ("cy", torch.nan),
        ("width", 0),
        ("height", 99999),
    ],
)
def test_impossible_cameras(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"camera.{field} must be .* got {value}"):
        render(replace(SCENE, camera=replace(SCENE.camera, **{field: value})))


def test_a_picture_of_more_values_than_a_gpu_counts() -> None:
    side = 26_755
    for sides in ((side, side), (32_768, 21_846)):
        wide = replace(SCENE.camera, width=sides[0], height=sides[1])
        with pytest.raises(ValueError, match=f"camera has {sides[0]}x{sides[1]} pixels; a GPU draws at most 715827882"):
            _check_camera(wide, SCENE.gaussians.means.device, "gpu")
        _check_camera(wide, SCENE.gaussians.means.device, "cpu")


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize(("name", "at"), [("R_cam_world", (2, 1)), ("t_cam_world", (1,))])
@pytest.mark.parametrize("backend", BACKENDS)
def test_camera_with_a_non_finite_pose(backend: str, name: str, at: tuple[int, ...], value: float) -> None:
    pose = getattr(SCENE.camera, name).clone()
    pose[at] = value
    message = rf"{name} has 1 non-finite of {pose.numel()} values, the first at \[{', '.join(map(str, at))}\]"
    with pytest.raises(ValueError, match=message):
        render(replace(SCENE, camera=replace(SCENE.camera, **{name: pose})), backend)
