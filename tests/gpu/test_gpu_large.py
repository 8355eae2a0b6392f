"""More values than 32 bits count: the heads of a million Gaussians with latents of 200 dimensions, 45 million splats."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from interpreter import DEVICE

pytest.importorskip("triton", reason="Triton is not installed")

import triton
import triton.language as tl

from avatar.compute.device import interpreted
from avatar.gaussians.hyper_cpu import packed_shape
from avatar.kernels.adam import adam
from avatar.kernels.hyper import first_row
from avatar.splat import CannotDraw, gpu_draw, splat, splat_features
from avatar.splat.scenes import head_camera
from avatar.types import Gaussians

MANY, LANES = 1 << 31, 1024


@triton.jit
def place_of(packed, i, latents, out):
    tl.store(out, (first_row(packed, tl.load(i), tl.load(latents)).to(tl.int64) - packed.to(tl.int64)) // 4)


@pytest.mark.parametrize(("gaussians", "latents"), [(14_876, 8), (2_600_000, 64), (1_000_000, 200)])
def test_every_gaussian_has_its_own_place_in_the_heads(gaussians: int, latents: int) -> None:
    blocks, rows, packed = packed_shape(gaussians, latents)
    i, n = (torch.tensor([value], dtype=torch.int32, device=DEVICE) for value in (gaussians - 1, latents))
    out = torch.zeros(1, dtype=torch.int64, device=DEVICE)
    place_of[(1,)](torch.zeros(1, device=DEVICE), i, n, out)
    assert int(out) == (blocks - 1) * rows * packed + (gaussians - 1) % packed


@pytest.mark.skipif(not interpreted(), reason="only Triton's interpreter can run the last program alone")
def test_adam_moves_the_last_of_many_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from triton.runtime import interpreter

    def sparse(name: str) -> torch.Tensor:  # with room before it, for what is taken for a negative number
        return torch.from_file(str(tmp_path / name), shared=True, size=2 * MANY + LANES)[MANY:]

    try:
        parameter, gradient, mean, square = map(sparse, ("parameter", "gradient", "mean", "square"))
    except RuntimeError as error:
        pytest.skip(f"a sparse file of 16 GiB cannot be made here: {error}")
    gradient[MANY:] = 2.0
    one, zero = torch.ones(()), torch.zeros(())
    builder = interpreter.interpreter_builder
    monkeypatch.setattr(builder, "set_grid_idx", lambda *_: setattr(builder, "grid_idx", (MANY // LANES, 0, 0)))
    own = parameter, gradient, mean, square, 0.1, one, one, zero, len(parameter)
    betas = {"BETA1": 0.9, "BETA2": 0.999, "LOG2_BETA1": -0.152, "LOG2_BETA2": -0.00144}
    adam[(1,)](*own, EPSILON=1e-8, BLOCK=LANES, **betas)
    assert torch.allclose(parameter[MANY:], torch.tensor(-0.1), rtol=2e-3)


def without_values(count: int, coefficients: int) -> Gaussians:
    shapes = (count, 3), (count, 4), (count, 3), (count,), (count, coefficients, 3)
    return Gaussians(*(torch.empty(shape, device="meta") for shape in shapes))


@pytest.mark.without_kernels
@pytest.mark.parametrize(("most", "coefficients"), [(44_739_242, 16), (238_609_294, 1)])
def test_splats_whose_values_a_gpu_does_not_count_are_refused(most: int, coefficients: int) -> None:
    view, background = head_camera(64), torch.zeros(3, device="meta")
    splat(without_values(most, coefficients), view, background)
    with pytest.raises(CannotDraw, match=rf"^{most + 1} Gaussians have \d+ values in a buffer; .* less than 2\^31$"):
        splat(without_values(most + 1, coefficients), view, background)


@pytest.mark.without_kernels
def test_so_are_features_of_pictures_that_a_gpu_draws_in_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_draw, "TUNING", gpu_draw.Tuning())
    gaussians, view, background = without_values(1000, 1), head_camera(26_750), torch.zeros(3, device="meta")
    splat(gaussians, view, background)
    features = torch.empty(1000, 3, device="meta")
    with pytest.raises(CannotDraw, match=r"^67108864 pairs of 11182336 tiles and a splat have 2214\d+ values"):
        splat_features(*gaussians[:4], features, view, background)
