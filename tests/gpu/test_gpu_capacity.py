"""Room for pairs of tile and splat: what happens when it does not suffice, and values that nobody waits for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from interpreter import DEVICE
from splat.scenes import (
    POSE,
    SCENES,
    Scene,
    camera,
    gradients,
    inputs_of,
    random_gaussians,
    render,
    with_inputs,
)

from avatar.splat import CannotDraw, _checked_options, splat
from avatar.splat.capacity import CAPACITIES, MAX_PAIRS, Capacities, Kind, fixed_capacity, roomy
from avatar.types import Gaussians

SCENE = SCENES["17x33"]


def pairs_of(scene: Scene) -> int:
    """What the drawing needs, before pairs without a pixel are left out."""
    from avatar.splat.gpu import pose_on, settings_of
    from avatar.splat.gpu_draw import draw

    given = {**(splat.__kwdefaults__ or {}), **scene.options, "backend": "gpu"}
    settings = settings_of(
        scene.camera, DEVICE, **_checked_options(scene.gaussians, scene.camera, scene.background, **given)
    )
    gaussians = Gaussians(*(t.detach().contiguous() for t in scene.gaussians))
    _, drawing = draw(gaussians, pose_on(scene.camera, DEVICE), scene.background, settings)
    return int(drawing.ends[-1])


@pytest.mark.skipif(DEVICE.type == "cuda", reason="counts where Triton interprets")
def test_room_for_exactly_the_pairs_is_enough_and_one_less_makes_the_image_nan() -> None:
    expected, needed = render(SCENE, "gpu"), pairs_of(SCENE)
    for capacity in (needed, needed + 1, 10 * needed):
        with fixed_capacity(capacity):
            found = render(SCENE, "gpu")
        assert torch.equal(found.image, expected.image) and torch.equal(found.alpha, expected.alpha)
    with fixed_capacity(needed - 1):
        spoilt = render(SCENE, "gpu")
    assert spoilt.image.isnan().all() and spoilt.alpha.isnan().all()


def test_gradients_of_a_drawing_without_room_are_zero_and_no_garbage() -> None:
    with fixed_capacity(3):
        found = gradients(SCENE, "gpu", torch.ones(33, 17, 3), None)
    background = found.pop("background")
    assert background.shape == (3,)
    assert all((gradient == 0).all() for gradient in found.values())


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh", "background"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_value_that_is_not_finite_spoils_the_image_where_nobody_waits(field: str, value: float) -> None:
    tensor = (SCENE.background if field == "background" else getattr(SCENE.gaussians, field)).clone()
    tensor.view(-1)[-1] = value
    scene = replace(SCENE, background=tensor) if field == "background" else SCENE
    if field != "background":
        scene = replace(SCENE, gaussians=SCENE.gaussians._replace(**{field: tensor}))
    with fixed_capacity(10_000):
        found = render(scene, "gpu")
    image = found.image[..., -1] if field == "background" else found.image
    assert not torch.isfinite(image).any()


@pytest.mark.parametrize("name", POSE)
@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
def test_so_does_one_of_a_pose_that_is_on_the_gpu(name: str, value: float) -> None:
    from avatar.splat.gpu import splat_gpu  # `splat` looks at a pose on the CPU, where Triton interprets

    options: dict[str, Any] = {**(splat.__kwdefaults__ or {}), "backend": "cpu"}
    pose = getattr(SCENE.camera, name).clone()
    pose.view(-1)[1] = value
    inputs = {name: tensor.to(DEVICE) for name, tensor in {**inputs_of(SCENE), name: pose}.items()}
    scene = with_inputs(SCENE, inputs)
    checked = _checked_options(SCENE.gaussians, SCENE.camera, SCENE.background, **options)
    with fixed_capacity(10_000):
        found = splat_gpu(scene.gaussians, scene.camera, scene.background, **checked)
    assert found.image.isnan().all() and found.alpha.isnan().all()
    CAPACITIES.forget()
    with pytest.raises(CannotDraw, match=f"{name} has 1 non-finite of"):
        splat_gpu(scene.gaussians, scene.camera, scene.background, **checked)


def test_a_value_that_is_not_finite_spoils_the_image_although_its_splat_is_hidden() -> None:
    opacities, sh = SCENE.gaussians.opacities.clone(), SCENE.gaussians.sh.clone()
    opacities[3], sh[3, 2, 1] = 0.0, torch.nan
    with fixed_capacity(10_000):
        found = render(replace(SCENE, gaussians=SCENE.gaussians._replace(opacities=opacities, sh=sh)), "gpu")
    assert found.image.isnan().all()


def test_a_colour_that_overflows_spoils_the_image_if_it_would_show() -> None:
    g = random_gaussians(9)
    sh = g.sh.clone()
    sh[7] = 3e38
    view = camera(20, 20, yaw=0.0)
    with fixed_capacity(10_000):
        assert render(Scene(g._replace(sh=sh, means=g.means * 0.1), view), "gpu").image.isnan().all()
        aside = g.means * 0.1 + torch.tensor([30.0, 0.0, 0.0]) * (torch.arange(9) == 7)[:, None]
        assert torch.isfinite(render(Scene(g._replace(sh=sh, means=aside), view), "gpu").image).all()


def test_no_capacity_is_refused() -> None:
    with fixed_capacity(0), pytest.raises(ValueError, match="the capacity must be 1 to 67108864 pairs"):
        render(SCENE, "gpu")


def test_the_fixed_capacity_ends_with_its_block() -> None:
    with fixed_capacity(3):
        assert CAPACITIES.known(Kind(torch.device("cuda", 0), 5, 5)) == 3
    assert CAPACITIES.fixed is None


def test_capacities_are_learnt_by_kind_grow_and_are_forgotten() -> None:
    capacities, one, other = Capacities(), Kind(torch.device("cuda", 0), 5, 5), Kind(torch.device("cuda", 0), 5, 6)
    assert capacities.known(one) is None
    first = capacities.learn(one, 100_000)
    assert 150_000 <= first < 160_000 and capacities.known(one) == first and capacities.known(other) is None
    for needed, expected in ((100_000, first), (first, roomy(first)), (MAX_PAIRS + 1, roomy(first))):
        capacities._grow(one, needed)
        assert capacities.known(one) == expected
    capacities.forget()
    assert capacities.known(one) is None


def test_where_triton_interprets_every_drawing_waits() -> None:
    capacities, kind = Capacities(), Kind(torch.device("cpu"), 5, 5)
    capacities.learn(kind, 10)
    assert capacities.known(kind) is None


def test_there_is_room_where_nothing_is_needed_and_never_too_much() -> None:
    assert roomy(0) > 0
    assert roomy(MAX_PAIRS) == MAX_PAIRS
    # int32 finds every value of a record, with room for the tiles' rounding.
    assert 9 * (MAX_PAIRS + 32 * 2**20) < 2**31
