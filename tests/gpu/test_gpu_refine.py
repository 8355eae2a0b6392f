"""Refinement of a tracking on the GPU's path: the CPU's misfit, gradient and way down, and nothing that is read back."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import cast

import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, wrongly_tracked
from interpreter import DEVICE, error, the_cpus_way
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from kornia.geometry.conversions import vector_to_skew_symmetric_matrix

from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement import refine_subject as refine_module
from avatar.pose_refinement.parallel import read_later
from avatar.pose_refinement.refine_subject import _Work, frozen
from avatar.pose_refinement.tracking_values import head_params, rotation
from avatar.splat import CannotDraw, gpu_buffers

FRAME = 1


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Avatar]:
    with the_cpus_way():
        avatar = patterned_avatar(tmp_path_factory.mktemp("head"), "model.uv_size=24")
    with frozen(avatar):
        yield avatar


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    with the_cpus_way():
        return wrongly_tracked(drawn_clip(avatar, frames=4, train=3))


def work_on(avatar: Avatar, clip: Clip) -> _Work:
    return _Work(avatar, cast(Subject, clip), SIZE, BACKGROUND)


@pytest.fixture
def on_cpu(avatar: Avatar, clip: Clip) -> _Work:
    with the_cpus_way():
        return work_on(avatar.to("cpu"), clip)


def test_picture_misfit_and_gradient_are_those_of_the_cpu(avatar: Avatar, clip: Clip, on_cpu: _Work) -> None:
    moves = 0.3 * torch.randn(len(on_cpu.parameterization.index), generator=torch.Generator().manual_seed(0))
    with the_cpus_way():
        made = on_cpu.targets(FRAME, 1)
        assert made is not None
        values = on_cpu.parameterization.values(FRAME, moves)
        expected = on_cpu.fitter.fit(values, on_cpu.pose(FRAME), made[0])
        figures = on_cpu.fitter.figures(values, on_cpu.pose(FRAME), made[0])
        (picture,) = on_cpu.fitter.pictures(values, on_cpu.pose(FRAME), made[0])
    work = work_on(avatar.to(DEVICE), clip)
    found_targets = work.targets(FRAME, 1)
    assert work.is_gpu and found_targets is not None
    values = work.there.values(FRAME, moves.to(DEVICE))
    found = work.fitter.fit(values, work.pose(FRAME), found_targets[0])
    assert float(found.misfit) == pytest.approx(float(expected.misfit), rel=1e-4)
    assert error(found.gradient, expected.gradient) < 1e-3
    assert (found.pictures[0].cpu() - expected.pictures[0]).abs().mean() < 1e-5
    (seen,) = work.fitter.pictures(values, work.pose(FRAME), found_targets[0])
    assert (seen.cpu() - picture).abs().mean() < 1e-5
    own = work.fitter.figures(values, work.pose(FRAME), found_targets[0])
    assert own.tolist() == pytest.approx(figures.tolist(), rel=1e-4)


def test_the_way_down_is_that_of_the_cpu(
    avatar: Avatar, clip: Clip, on_cpu: _Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A curvature that is too small: the first step goes too far and is not taken, the second is."""
    monkeypatch.setattr(refine_module, "FINE_STEPS", 2)
    factor = 0.5 * torch.eye(len(on_cpu.parameterization.index))
    with the_cpus_way():
        (expected,) = on_cpu.refined([FRAME], [factor])
    (found,) = work_on(avatar.to(DEVICE), clip).refined([FRAME], [factor.to(DEVICE)])
    assert expected.figures[2] > expected.figures[1] + 1.0, "there was something to find"
    assert error(found.moves, expected.moves) < 2e-3
    assert found.figures == pytest.approx(expected.figures, rel=1e-3)


@pytest.mark.without_kernels
def test_a_frame_reads_nothing_back(avatar: Avatar, clip: Clip) -> None:
    """On the meta device there is nothing to read."""
    avatar = deepcopy(avatar).to("cpu")
    avatar.embedding.touching(avatar.head.assets.num_vertices)  # counted once, on the CPU: only numbers can be counted
    work = work_on(avatar.to("meta"), clip)
    work.levels = 2
    factor = torch.eye(len(work.parameterization.index), device="meta")
    begun, curvatures = work.refine(FRAME, [factor, factor]), work._curvatures(FRAME)
    assert begun is not None and begun.is_meta and begun.shape == (len(factor) + 3,)
    assert curvatures is not None and curvatures.is_meta and curvatures.shape == (2, *factor.shape)


@pytest.mark.without_kernels
def test_turns_are_the_same_without_an_exponential(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    vectors = torch.tensor([[0.0, 0.0, 0.0], [1e-4, 0.0, -2e-4], [0.3, -0.2, 0.9], [2.0, 1.0, -2.0]]).double()
    expected = rotation(vectors)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    torch.testing.assert_close(rotation(vectors), expected, rtol=0, atol=1e-12)
    derivative = torch.autograd.functional.jacobian(rotation, torch.zeros(3).double())
    assert derivative[1, 0, 2] == 1.0 and derivative[0, 1, 2] == -1.0 and bool(derivative.isfinite().all())
    skew = vector_to_skew_symmetric_matrix(vectors)
    torch.testing.assert_close(expected, torch.linalg.matrix_exp(skew), rtol=0, atol=1e-12)


@pytest.mark.without_kernels
def test_what_comes_back_with_a_nan_is_begun_again_to_raise_what_was_wrong() -> None:
    def begin(item: int) -> Tensor | None:
        if item == 4 and gpu_buffers._checked.get():
            raise CannotDraw(f"item {item}")
        return None if item == 3 else torch.tensor([torch.nan if item == 4 else item])

    found: list[float | None] = []
    with pytest.raises(CannotDraw, match="item 4"):
        found.extend(None if one is None else float(one) for one in read_later(begin, range(6)))
    assert found == [0, 1, 2, None]


def test_the_head_poses_on_the_device_as_on_the_cpu(avatar: Avatar, clip: Clip) -> None:
    values = 0.1 * torch.randn(20 + 6, generator=torch.Generator().manual_seed(1))
    with the_cpus_way():
        expected = avatar.head.vertices(head_params(values))
    assert error(avatar.head.on(DEVICE).vertices(head_params(values.to(DEVICE))), expected) < 1e-6
