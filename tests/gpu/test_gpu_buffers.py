"""Buffers for pairs of tile and splat: how large they are, drawings that exceed them, and values that nobody waits for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from interpreter import DEVICE, as_on_a_gpu
from splat.features import draw, with_features
from splat.scenes import (
    POSE,
    SCENES,
    Scene,
    camera,
    checked_options,
    gradients,
    inputs_of,
    random_gaussians,
    render,
    with_inputs,
)
from torch.utils._python_dispatch import TorchDispatchMode

from avatar.splat import CannotDraw, gpu_buffers
from avatar.splat.gpu_buffers import (
    BYTES,
    HEADROOM,
    MAX_PAIRS,
    Kind,
    capacity_of,
    capacity_with_headroom,
    checked_drawings,
    most_pairs,
)
from avatar.types import Gaussians

SCENE = SCENES["17x33"]


def pairs_of(scene: Scene) -> int:
    """What the drawing needs, before pairs without a pixel are left out."""
    from avatar.splat.gpu import pose_on, settings_of
    from avatar.splat.gpu_draw import draw

    settings = settings_of(scene.camera, DEVICE, checked_options(scene, "gpu"))
    gaussians = Gaussians(*(t.detach().contiguous() for t in scene.gaussians))
    _, drawing = draw(gaussians, pose_on(scene.camera, DEVICE), scene.background, settings)
    return int(drawing.ends[-1])


@pytest.mark.skipif(DEVICE.type == "cuda", reason="counts where Triton interprets")
def test_room_for_exactly_the_pairs_is_enough_and_one_less_makes_the_image_nan() -> None:
    expected, needed = render(SCENE, "gpu"), pairs_of(SCENE)
    for capacity in (needed, needed + 1, 10 * needed):
        with as_on_a_gpu(capacity):
            found = render(SCENE, "gpu")
        assert torch.equal(found.image, expected.image) and torch.equal(found.alpha, expected.alpha)
    with as_on_a_gpu(needed - 1):
        spoilt = render(SCENE, "gpu")
        with (
            checked_drawings(),
            pytest.raises(CannotDraw, match=f"needs {needed} pairs .* hold {needed - 1}; .*--size"),
        ):
            render(SCENE, "gpu")
    assert spoilt.image.isnan().all() and spoilt.alpha.isnan().all()


def test_gradients_of_a_drawing_without_room_are_zero_and_no_garbage() -> None:
    with as_on_a_gpu(3):
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
    with as_on_a_gpu(10_000):
        found = render(scene, "gpu")
    image = found.image[..., -1] if field == "background" else found.image
    assert not torch.isfinite(image).any()


def test_a_feature_that_is_not_finite_spoils_the_image_where_nobody_waits() -> None:
    inputs = with_features(SCENE, 5)
    inputs["features"][-1, -1] = torch.nan
    with as_on_a_gpu(10_000):
        found = draw(SCENE, inputs, "gpu")
    assert found.image.isnan().all() and found.alpha.isnan().all()
    with as_on_a_gpu(3):
        assert draw(SCENE, with_features(SCENE, 5), "gpu").image.isnan().all()


@pytest.mark.parametrize("name", POSE)
@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
def test_so_does_one_of_a_pose_that_is_on_the_gpu(name: str, value: float) -> None:
    from avatar.splat.gpu import splat_gpu  # `splat` looks at a pose on the CPU, where Triton interprets

    pose = getattr(SCENE.camera, name).clone()
    pose.view(-1)[1] = value
    inputs = {name: tensor.to(DEVICE) for name, tensor in {**inputs_of(SCENE), name: pose}.items()}
    scene = with_inputs(SCENE, inputs)
    checked = checked_options(SCENE, "cpu")
    with as_on_a_gpu(10_000):
        found = splat_gpu(scene.gaussians, scene.camera, scene.background, checked)
    assert found.image.isnan().all() and found.alpha.isnan().all()
    with checked_drawings(), pytest.raises(CannotDraw, match=f"{name} has 1 non-finite of"):
        splat_gpu(scene.gaussians, scene.camera, scene.background, checked)


def test_a_value_that_is_not_finite_spoils_the_image_although_its_splat_is_hidden() -> None:
    opacities, sh = SCENE.gaussians.opacities.clone(), SCENE.gaussians.sh.clone()
    opacities[3], sh[3, 2, 1] = 0.0, torch.nan
    with as_on_a_gpu(10_000):
        found = render(replace(SCENE, gaussians=SCENE.gaussians._replace(opacities=opacities, sh=sh)), "gpu")
    assert found.image.isnan().all()


def test_a_colour_that_overflows_spoils_the_image_if_it_would_show() -> None:
    g = random_gaussians(9)
    sh = g.sh.clone()
    sh[7] = 3e38
    view = camera(20, 20, yaw=0.0)
    with as_on_a_gpu(10_000):
        assert render(Scene(g._replace(sh=sh, means=g.means * 0.1), view), "gpu").image.isnan().all()
        aside = g.means * 0.1 + torch.tensor([30.0, 0.0, 0.0]) * (torch.arange(9) == 7)[:, None]
        assert torch.isfinite(render(Scene(g._replace(sh=sh, means=aside), view), "gpu").image).all()


KIND = Kind(DEVICE, splats=1000, tiles=1000, alpha_min=1 / 255)


def never() -> int:
    raise AssertionError("a drawing waited")


def test_the_first_drawing_of_a_kind_waits_and_fixes_the_capacity_of_all() -> None:
    with as_on_a_gpu():
        capacity = capacity_of(KIND, lambda: 50_000)
        assert capacity == HEADROOM * 50_000 == capacity_of(KIND, never)
        assert capacity_of(KIND._replace(tiles=1001), lambda: 60_000) == HEADROOM * 60_000
        assert capacity_of(KIND, never) == capacity
        with checked_drawings():
            assert capacity_of(KIND, lambda: capacity) == capacity
            with pytest.raises(CannotDraw, match=f"needs {capacity + 1} pairs"):
                capacity_of(KIND, lambda: capacity + 1)


def test_checked_drawings_fix_nothing_and_hold_what_each_needs() -> None:
    with as_on_a_gpu() as fixed:
        with checked_drawings():
            for needed in (0, 50_000, 1_000_000, 7):
                assert needed < capacity_of(KIND, lambda needed=needed: needed) <= needed + 4096
        assert not fixed
        with checked_drawings(), pytest.raises(KeyError), checked_drawings():
            raise KeyError
        assert capacity_of(KIND, lambda: 50_000) == HEADROOM * 50_000


def test_a_capacity_has_headroom_and_is_bounded() -> None:
    nothing_drawn = capacity_with_headroom(KIND, 0, None)
    assert 50_000 < nothing_drawn < 100_000, "a first drawing that shows nothing says nothing of the next"
    assert capacity_with_headroom(KIND, 10, None) == nothing_drawn
    assert capacity_with_headroom(KIND._replace(splats=3), 10, None) == most_pairs(KIND._replace(splats=3)) == 3000
    huge = KIND._replace(splats=10**6)
    assert (
        capacity_with_headroom(huge, MAX_PAIRS - 1, None) == capacity_with_headroom(huge, MAX_PAIRS, None) == MAX_PAIRS
    )
    # Half of the free memory for the headroom; what is needed is asked for in any case.
    assert capacity_with_headroom(huge, 10**6, 2 * BYTES * 1.5e6) == 1_500_000
    assert capacity_with_headroom(huge, 10**6, 0.0) == 10**6
    # int32 finds every value of a record, with room for the tiles' rounding.
    assert 9 * (MAX_PAIRS + 32 * 2**20) < 2**31


class Allocated(TorchDispatchMode):
    """Bytes of the tensors that torch.empty and torch.sort give."""

    total = 0

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        made = function(*arguments, **(named or {}))
        if function.overloadpacket.__name__ in ("empty", "sort"):
            self.total += sum(tensor.nbytes for tensor in (made if isinstance(made, tuple) else (made,)))
        return made


def test_the_bytes_of_a_pair_are_those_of_the_buffers() -> None:
    totals = []
    for capacity in (8_000, 16_000):
        with as_on_a_gpu(capacity), Allocated() as allocated:
            gradients(SCENE, "gpu", torch.ones(33, 17, 3), None)
        totals.append(allocated.total)
    sorting, wide_keys = 16, 4  # inside of torch.sort; a key takes 2 bytes in these few tiles
    assert (totals[1] - totals[0]) / 8_000 + sorting + wide_keys == BYTES


def test_other_cut_offs_are_another_kind_of_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("HEADROOM", 1), ("PER_SPLAT", 0), ("PER_TILE", 0)):
        monkeypatch.setattr(gpu_buffers, name, value)
    with as_on_a_gpu():
        for alpha_min in (0.5, 0.0):
            assert torch.isfinite(render(SCENE.with_options(alpha_min=alpha_min), "gpu").image).all(), alpha_min
