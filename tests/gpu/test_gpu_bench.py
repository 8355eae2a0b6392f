"""`avatar bench splat` on a GPU: what it draws there is compared like everything else. What asks gsplat asks correctly."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from compare_gsplat import splat_gsplat

from avatar.bench import splat as bench
from avatar.bench.splat import Variant, all_variants, passes_of, reference_of, validate
from avatar.errors import UserError
from avatar.splat.scenes import head_camera, head_shell
from avatar.types import Rendering

SHELL, SIZE = head_shell(40), 24
GPU = Variant("gpu", 40, SIZE, 1, "")


def test_it_is_validated_and_both_its_passes_run() -> None:
    accuracy = validate(GPU, SHELL, SIZE, reference_of(SHELL, SIZE))
    assert 0 < accuracy.image < 1e-5 and 0 < accuracy.gradient < 1e-4
    passes = passes_of(GPU, SHELL, SIZE)
    passes["forward"]()
    gradients: Any = passes["backward"]()
    assert len(gradients) == 5 and all(gradient.any() for gradient in gradients)


def test_wrong_pictures_are_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, draw = reference_of(SHELL, SIZE), bench.draw
    monkeypatch.setattr(bench, "draw", lambda *a: Rendering(*(0.99 * field for field in draw(*a))))
    with pytest.raises(UserError, match="backend='gpu'.* is wrong, so it is not timed"):
        validate(GPU, SHELL, SIZE, truth)


@pytest.mark.without_kernels
def test_the_gpu_is_measured_where_it_is_asked_for() -> None:
    backends = {
        on_gpu: {v.backend for v in all_variants((16,), (20,), count=20, size=16, on_gpu=on_gpu)} - {"cpu", "reference"}
        for on_gpu in (False, True)
    }
    assert backends == {False: set(), True: {"gpu"}}


@pytest.mark.without_kernels
def test_gsplat_is_asked_for_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def rasterization(
        means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, *rest: Any, **named: Any
    ) -> Any:
        asked.update(means=means, opacities=opacities, colors=colors, rest=rest, named=named)
        return torch.full((1, SIZE, SIZE, 3), 0.25), torch.full((1, SIZE, SIZE, 1), 0.5), {}

    stand_in = ModuleType("gsplat")
    stand_in.rasterization = rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    camera = head_camera(SIZE)
    drawn = splat_gsplat(SHELL, camera)
    assert drawn.image.shape == (SIZE, SIZE, 3) and drawn.alpha.shape == (SIZE, SIZE)
    view, intrinsics, width, height = asked["rest"]
    point = torch.cat((SHELL.means[0], torch.ones(1)))
    assert torch.allclose((view[0] @ point)[:3], camera.R_cam_world @ SHELL.means[0] + camera.t_cam_world)
    wanted = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    assert torch.equal(intrinsics[0], wanted)
    assert (width, height, asked["named"]["sh_degree"]) == (SIZE, SIZE, 3)
    assert asked["colors"].shape == (40, 16, 3) and asked["opacities"].shape == (40,)
