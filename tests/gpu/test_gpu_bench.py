"""`avatar bench splat` on a GPU: what it draws there is compared like everything else, and gsplat is asked correctly."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from interpreter import HAS_GPU

from avatar.bench import splat as bench
from avatar.bench import splat_gpu
from avatar.bench.splat import Variant, all_variants, passes_of, reference_of, validate
from avatar.bench.splat_gpu import gpu_backends, splat_gsplat
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
def test_what_draws_here_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    backends: dict[tuple[bool, bool], set[str]] = {}
    for has_gpu in (False, True):
        for has_gsplat in (False, True):
            monkeypatch.setattr(torch.cuda, "is_available", lambda has_gpu=has_gpu: has_gpu)
            monkeypatch.setattr(splat_gpu, "find_spec", lambda _, has_gsplat=has_gsplat: has_gsplat or None)
            variants = all_variants((16,), (20,), count=20, size=16)
            backends[has_gpu, has_gsplat] = {v.backend for v in variants} - {"cpu", "reference"}
    assert backends == {
        (False, False): set(),
        (False, True): set(),
        (True, False): {"gpu"},
        (True, True): {"gpu", "gsplat"},
    }
    assert gpu_backends() == ("gpu", "gsplat")


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


@pytest.mark.without_kernels
@pytest.mark.skipif(HAS_GPU, reason="there is a GPU")
def test_without_a_gpu_no_other_splatter_is_timed() -> None:
    assert gpu_backends() == ()
