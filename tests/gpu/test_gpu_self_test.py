"""The self-test: it passes where the kernels are right, and names what is wrong where they are not."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from interpreter import DEVICE, HAS_GPU, the_cpus_way
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.pipeline import self_test as module
from avatar.pipeline.self_test import TOLERANCE, WrongGpu, self_test
from avatar.splat import gpu
from avatar.types import Gaussians

SCENES = ("placed", "faint_scene", "opaque_scene")


@pytest.fixture(autouse=True)
def _compared_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Triton interprets, both devices are the CPU: the first drawing of each scene is to be the compiled core's."""
    if HAS_GPU:
        return

    def alternating(make: Callable[[torch.device], Any]) -> Callable[[torch.device], Any]:
        calls = [0]

        def made(device: torch.device) -> Any:
            calls[0] += 1
            if calls[0] % 2 == 0:
                return make(device)
            with the_cpus_way():
                return make(device)

        return made

    for name in SCENES:
        monkeypatch.setattr(module, name, alternating(getattr(module, name)))


def test_right_kernels_pass_and_every_field_was_compared() -> None:
    errors = self_test(DEVICE)
    assert 0 < max(errors.values()) < TOLERANCE / 5
    for field in ("means", "gradient of packed", "gradient of vertices"):
        assert f"{field} of the placed avatar" in errors
    for scene in ("faint", "opaque"):
        for field in ("image", "alpha", "loss", "gradient of sh", "gradient of quats", "gradient of background"):
            assert f"{field} of the {scene} scene" in errors
    for field in ("gradient of R_cam_world", "gradient of t_cam_world"):
        assert f"{field} of the faint scene" in errors and f"{field} of the opaque scene" not in errors
    assert len(errors) > 20


@pytest.fixture
def faint_scene_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("placed", "opaque_scene"):
        monkeypatch.setattr(module, name, lambda _: {})
    monkeypatch.setattr(module, "COUNT", 60)
    monkeypatch.setattr(module, "SIZE", 32)


@pytest.mark.usefixtures("faint_scene_only")
@pytest.mark.parametrize("factor", [1.001, float("nan")])
def test_a_wrong_gradient_is_named(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    right = gpu.backward

    def wrong(*arguments: Any, **named: Any) -> tuple[Gaussians, Tensor | None]:
        found, by_pose = right(*arguments, **named)
        return found._replace(opacities=found.opacities * factor), by_pose

    monkeypatch.setattr(gpu, "backward", wrong)
    with pytest.raises(WrongGpu) as caught:
        self_test(DEVICE)
    message = str(caught.value)
    assert re.search("the gradient of opacities of the faint scene is off by (1.0e-03|nan) of ", message)
    assert f"torch {torch.__version__}" in message and "use --device cpu, and report this" in message


@pytest.mark.usefixtures("faint_scene_only")
def test_a_wrong_image_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    right = gpu.draw

    def wrong(*arguments: Any) -> Any:
        rendering, *rest = right(*arguments)
        image: Tensor = rendering.image
        image[3, 4, 1] += 1e-2
        return rendering, *rest

    monkeypatch.setattr(gpu, "draw", wrong)
    with pytest.raises(WrongGpu, match="the image of the faint scene is off by"):
        self_test(DEVICE)
