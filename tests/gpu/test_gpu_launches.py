"""What a step and a frame launch; and that they read nothing back, which cannot be done on the meta device."""

from __future__ import annotations

import importlib.util
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from heads import grid_head

from avatar.losses.photometric import dssim
from avatar.splat import splat
from avatar.splat.scenes import head_camera, head_shell
from avatar.train.loss import PerceptualTerm, Weighted
from avatar.types import Gaussians

pytest.importorskip("triton", reason="Triton is not installed")
pytestmark = pytest.mark.without_kernels  # the meta device has none

MOST_IN_A_STEP, MOST_ON_AVERAGE, MOST_IN_A_FRAME = 150, 175, 60
STAND_IN = PerceptualTerm("dssim", Weighted(dssim, 0.05))


@pytest.fixture(scope="module")
def counting() -> ModuleType:
    path = Path(__file__).resolve().parents[2] / "scripts" / "count_launches.py"
    spec = importlib.util.spec_from_file_location("count_launches", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def counts(counting: ModuleType) -> dict[str, Counter[str]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("avatar.train.loss.SH_INTERVAL", 500)  # as outside of the tests
        return counting.count_all(grid_head(), 32, 64)


def test_a_fast_step_and_a_frame_launch_little(counts: dict[str, Counter[str]]) -> None:
    for name in ("step, first half", "step with D-SSIM"):
        assert 50 < counts[name].total() <= MOST_IN_A_STEP, name
    assert 20 < counts["rendered frame"].total() <= MOST_IN_A_FRAME


def test_so_does_a_step_on_average_with_lpips_in_every_tenth(counts: dict[str, Counter[str]]) -> None:
    first, second, tenth = (counts[name].total() for name in list(counts)[:3])
    assert (first + 0.9 * second + 0.1 * tenth) / 2 <= MOST_ON_AVERAGE


def test_every_kernel_of_a_step_is_ours_once_or_twice(counts: dict[str, Counter[str]]) -> None:
    own = {name: count for name, count in counts["step with D-SSIM"].items() if name.startswith("our ")}
    assert own.keys() >= {
        "our project",
        "our composite",
        "our composite_backward",
        "our project_backward",
        "our fused_gaussians",
    }
    assert own.pop("our adam") == 22  # one for each parameter
    assert max(own.values()) <= 2


def test_a_drawing_launches_little_more_for_a_pose_that_is_on_the_gpu(counting: ModuleType) -> None:
    """And no more than ever for one that is not: forward, backward."""

    def launches(pose: tuple[torch.Tensor, torch.Tensor], *, differentiated: bool) -> tuple[int, int]:
        R, t = (part.requires_grad_(differentiated) for part in pose)
        shell = Gaussians(*(field.to(counting.META).requires_grad_() for field in head_shell(100)))
        with counting.counting() as forward:
            camera = replace(head_camera(64), R_cam_world=R, t_cam_world=t)
            image = splat(shell, camera, torch.zeros(3, device=counting.META)).image.sum()
        with counting.counting() as backward:
            torch.autograd.grad(image, [*shell, R, t] if differentiated else list(shell))
        assert backward["our project_backward"] == 1
        return forward.total(), backward.total()

    here = head_camera(64).R_cam_world, head_camera(64).t_cam_world
    there = tuple(part.to(counting.META) for part in here)
    launches(here, differentiated=False)  # brings what is brought once
    before = launches(here, differentiated=False)
    assert launches(there, differentiated=False) == (before[0] + 2, before[1])
    assert launches(there, differentiated=True) == (before[0] + 2, before[1] + 2)


@pytest.mark.parametrize("recipe", ["experiment=paper", "model=flashavatar"])
def test_other_recipes_read_nothing_back_either(counting: ModuleType, recipe: str) -> None:
    rehearsal = counting.Rehearsal(grid_head(), 32, 64, (recipe,))
    assert rehearsal.step(STAND_IN, late=True).total() > 50
    assert rehearsal.rendered().total() > 20


def test_the_rehearsal_would_notice_a_number_that_is_read_back(counting: ModuleType) -> None:
    def reading(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return dssim(image, target, mask) if mask.any().item() else image.sum()

    rehearsal = counting.Rehearsal(grid_head(), 32, 64)
    with pytest.raises(RuntimeError, match="meta"):
        rehearsal.step(PerceptualTerm("reading", Weighted(reading, 0.05)), late=True)


def test_the_rehearsal_would_notice_a_tensor_on_another_device(counting: ModuleType) -> None:
    rehearsal = counting.Rehearsal(grid_head(), 32, 64)
    rehearsal.frame = replace(rehearsal.frame, alpha=torch.ones(64, 64))
    with pytest.raises((RuntimeError, ValueError), match=r"meta|cpu"):
        rehearsal.step(STAND_IN, late=True)
