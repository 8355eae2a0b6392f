"""From the network's values to Gaussians: the kernels against the functions that they stand for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from heads import grid_head, random_params
from interpreter import DEVICE, error, the_cpus_way
from torch import Tensor

from avatar.gaussians.apply_offsets import apply_offsets
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.latent_grid import latent_grid
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.skull_binding import Skull, SkullBinding, bind_to_skull
from avatar.gaussians.uv import uv_texels
from avatar.head.model import HeadModel
from avatar.types import Gaussians

CASES = {
    "grid and heads": (True, True, 8),
    "grid, heads and skull": (True, True, 8, True),
    "heads": (False, True, 3),
    "neither": (False, False, 10),
    "skull alone": (False, False, 10, True),
    "wide": (True, True, 70),
}


class Scene:
    """Random values at all inputs of one size; the number of Gaussians is no multiple of anything."""

    def __init__(self, has_grid: bool, is_hyper: bool, latents: int, has_skull: bool = False) -> None:
        assets = grid_head()
        texels = uv_texels(assets, 22)
        head = HeadModel(assets, torch.zeros(3))
        self.embedding = Embedding(assets, texels)
        N = len(self.embedding)
        neutral = self.embedding.points(head.neutral_vertices())
        self.grid = latent_grid(assets, texels, neutral, 6).interpolate if has_grid else None
        g = torch.Generator().manual_seed(1)
        rows = N if self.grid is None else self.grid.num_cells
        heads = HyperHeads(N, latents)
        with torch.no_grad():
            heads.packed.copy_(0.3 * torch.randn(heads.packed.shape, generator=g))
            heads.set_heads(heads.heads())  # zeros where no Gaussian is
        with the_cpus_way():
            vertices = head.vertices(random_params())
        self.inputs: dict[str, Tensor | None] = {
            "vertices": vertices,
            "values": torch.randn(rows, latents, generator=g),
            "packed": heads.packed.detach() if is_hyper else None,
            "quats": torch.randn(N, 4, generator=g),
            "log_scales": torch.randn(N, 3, generator=g) - 4,
            "opacity_logits": 3 * torch.randn(N, generator=g),
            "neck": random_params().neck if has_skull else None,
            "skull_logits": torch.randn(N, generator=g) if has_skull else None,
        }
        self.skull = Skull.of(head, self.embedding)
        self.heads = heads
        self.sh = torch.randn(N, 4, 3, generator=g)
        self.cotangents = [torch.randn(shape, generator=g) for shape in ((N, 3), (N, 4), (N, 3), (N,))]

    def expected(self, vertices: Tensor, values: Tensor, packed: Tensor | None, *rest: Any) -> Gaussians:
        *base, neck, logits = rest
        with the_cpus_way():
            if self.grid is not None:
                values = self.grid(values)
            if packed is not None:
                values = torch.func.functional_call(self.heads, {"packed": packed}, (values,))
            skull_binding = None if logits is None else SkullBinding(self.skull, neck, logits)
            points = bind_to_skull(self.embedding.points(vertices), skull_binding)
            return apply_offsets(points, *base, self.sh, values)

    def found(self, vertices: Tensor, values: Tensor, packed: Tensor | None, *rest: Any) -> Gaussians:
        from avatar.gaussians.fused_gaussians_gpu import fused_gaussians_gpu

        self.embedding.move(DEVICE)
        if self.grid is not None:
            self.grid.move(DEVICE)
        *base, neck, logits = rest
        skull = Skull(self.skull.at_rest.to(DEVICE), self.skull.arms.to(DEVICE))
        skull_binding = None if logits is None else SkullBinding(skull, neck, logits)
        return fused_gaussians_gpu(
            vertices, values, packed, *base, self.sh.to(DEVICE), self.embedding, self.grid, skull_binding
        )

    def run(self, function: Callable[..., Gaussians], device: torch.device) -> tuple[Gaussians, dict[str, Tensor]]:
        leaves = {n: None if t is None else t.to(device).requires_grad_() for n, t in self.inputs.items()}
        placed = function(*leaves.values())
        given = {name: leaf for name, leaf in leaves.items() if leaf is not None}
        cotangents = [cotangent.to(device) for cotangent in self.cotangents]
        gradients = torch.autograd.grad(placed[:4], list(given.values()), cotangents)
        return placed, dict(zip(given, gradients, strict=True))


@pytest.mark.parametrize("name", CASES)
def test_gaussians_and_gradients_are_those_of_the_steps_one_by_one(name: str) -> None:
    scene = Scene(*CASES[name])
    expected, expected_gradients = scene.run(scene.expected, torch.device("cpu"))
    found, gradients = scene.run(scene.found, DEVICE)
    for field, own in zip(Gaussians._fields, zip(found, expected, strict=True), strict=True):
        assert error(*own) < 1e-6, field
    assert gradients.keys() == expected_gradients.keys()
    for field in gradients:
        assert error(gradients[field], expected_gradients[field]) < 2e-6, field


def test_offsets_that_are_nan_give_nan() -> None:
    scene = Scene(False, False, 10)
    values = scene.inputs["values"]
    assert values is not None
    values[7] = torch.nan
    placed, _ = scene.run(scene.found, DEVICE)
    for name in ("means", "quats", "scales"):
        assert getattr(placed, name)[7].isnan().all() and getattr(placed, name)[:7].isfinite().all(), name


def test_lanes_that_stand_for_no_gaussian_get_no_gradient() -> None:
    scene = Scene(True, True, 8)
    packed = scene.run(scene.found, DEVICE)[1]["packed"]
    N = len(scene.sh)
    assert N % 16 and (packed[-1, :, N % 16 :] == 0).all() and (packed[-1, :, : N % 16] != 0).any()


def test_without_gradients_nothing_is_kept_and_the_bits_are_the_same() -> None:
    scene = Scene(True, True, 8)
    with_gradients, _ = scene.run(scene.found, DEVICE)
    with torch.no_grad():
        without = scene.found(*(None if t is None else t.to(DEVICE) for t in scene.inputs.values()))
    assert all(torch.equal(a, b) for a, b in zip(with_gradients, without, strict=True))


def test_zero_quaternions_and_saturated_offsets_have_finite_gradients() -> None:
    scene = Scene(False, False, 10)
    quats, values = scene.inputs["quats"], scene.inputs["values"]
    assert quats is not None and values is not None
    quats[:3] = 0
    values[5:9] *= 1e4
    expected, expected_gradients = scene.run(scene.expected, torch.device("cpu"))
    found, gradients = scene.run(scene.found, DEVICE)
    for name in ("quats", "values"):
        assert torch.isfinite(gradients[name]).all()
        assert error(gradients[name], expected_gradients[name]) < 2e-6
    assert error(found.quats, expected.quats) < 1e-6


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("values", (5, 8), "values has|values must have shape"),
        ("packed", (3, 4, 16), "packed must have shape"),
        ("quats", (7, 4), "log_scales has N = |quats has N = 7"),
        ("opacity_logits", (7,), "opacity_logits has N = 7"),
        ("neck", (5,), "neck"),
        ("skull_logits", (7,), "skull_logits has N = 7"),
    ],
)
def test_wrong_sizes_are_named(name: str, shape: tuple[int, ...], message: str) -> None:
    scene = Scene(True, True, 8, True)
    scene.inputs[name] = torch.zeros(shape)
    with pytest.raises(ValueError, match=message):
        scene.run(scene.found, DEVICE)
