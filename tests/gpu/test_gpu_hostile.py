"""Whatever the memory held before and whichever program runs first: the same bits, and nothing written beside a buffer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from gpu.test_gpu_fused_gaussians import Scene as Placing
from gpu.test_gpu_losses import images
from gpu.test_gpu_pose import HEAD
from heads import random_params
from interpreter import Hostile, hostile_interpreter
from splat.features import cotangents, everything, with_features
from splat.scenes import SCENES, gradients, render
from torch import Tensor

from avatar.compute.device import interpreted
from avatar.losses.photometric import dssim, photometric_loss
from avatar.types import Gaussians, HeadParams

pytestmark = pytest.mark.skipif(not interpreted(), reason="only Triton's interpreter can be made hostile")


def everything_of(name: str, copy: Callable[[Tensor], Tensor]) -> list[Tensor]:
    scene = SCENES[name]
    g = torch.Generator().manual_seed(0)
    size = scene.camera.height, scene.camera.width
    cotangents = torch.randn(*size, 3, generator=g), torch.randn(*size, generator=g)
    own = replace(scene, gaussians=Gaussians(*map(copy, scene.gaussians)), background=copy(scene.background))
    return [*render(own, "gpu"), *gradients(own, "gpu", *map(copy, cotangents)).values()]


def everything_of_features(copy: Callable[[Tensor], Tensor]) -> list[Tensor]:
    scene = SCENES["walls"]
    inputs = {name: copy(tensor) for name, tensor in with_features(scene, 33).items()}
    drawn, by_name = everything(scene, inputs, "gpu", *map(copy, cotangents(scene, 33)))
    return [*drawn, *by_name.values()]


def everything_placed(copy: Callable[[Tensor], Tensor]) -> list[Tensor]:
    scene = Placing(True, True, 8)
    scene.inputs = {name: None if t is None else copy(t) for name, t in scene.inputs.items()}
    placed, found = scene.run(scene.found, torch.device("cpu"))
    return [*placed, *found.values()]


def everything_posed(copy: Callable[[Tensor], Tensor]) -> list[Tensor]:
    from avatar.head.pose_gpu import pose_gpu

    tensors = HEAD.pose_tensors(torch.device("cpu"))
    assert tensors is not None
    params = random_params(expressions=3)
    return [pose_gpu(type(tensors)(*map(copy, tensors)), HeadParams(**{n: copy(t) for n, t in vars(params).items()}))]


def everything_compared(copy: Callable[[Tensor], Tensor]) -> list[Tensor]:
    image, target, mask = map(copy, images("near"))
    leaf = image.requires_grad_()
    loss = photometric_loss(leaf, target, mask, mask, perceptual=dssim)
    return [loss.total, torch.autograd.grad(loss.total, leaf)[0]]


CASES: dict[str, Callable[[Callable[[Tensor], Tensor]], list[Tensor]]] = {
    **{
        name: lambda copy, name=name: everything_of(name, copy)
        for name in ("17x33", "opaque", "walls", "thresholds", "needles")
    },
    "features": everything_of_features,
    "placed": everything_placed,
    "posed": everything_posed,
    "compared": everything_compared,
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_bits_and_whole_bands(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = CASES[name](torch.clone)
    with hostile_interpreter(monkeypatch, seed=len(name)) as memory:
        found = CASES[name](memory.copy)
        memory.assert_bands_are_whole()
    assert len(memory.buffers) > 3
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_a_write_beside_a_buffer_is_seen() -> None:
    memory = Hostile()
    inside = memory.copy(torch.arange(5.0))
    memory.assert_bands_are_whole()
    torch.as_strided(inside, (1,), (1,), inside.storage_offset() + 5).fill_(0.0)
    with pytest.raises(AssertionError, match=r"torch.float32 \[5\] was overrun"):
        memory.assert_bands_are_whole()


def test_memory_that_is_asked_for_holds_poison() -> None:
    with Hostile():
        fresh: list[Any] = [torch.empty(3), torch.empty_like(torch.zeros(2)), torch.zeros(1).new_empty(4)]
    assert all(tensor.isnan().all() for tensor in fresh)
