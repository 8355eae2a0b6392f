from __future__ import annotations

import pytest
import torch

from avatar.bench.machine import available_simd
from avatar.gaussians.hyper_cpu import Interpolation


def mixture(num: int, cells: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return (
        torch.randint(cells, (num, 4), generator=generator),
        torch.rand(num, 4, generator=generator),
    )


def plain(grid: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    return (grid[cells] * weights[..., None]).sum(1)


@pytest.mark.parametrize("simd", available_simd())
@pytest.mark.parametrize("n", [1, 3, 8, 13, 32])
@pytest.mark.parametrize("num", [0, 1, 7, 1000])
def test_values_and_gradients_are_those_of_plain_torch(
    num: int, n: int, simd: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AVATAR_SIMD", simd)
    cells, weights = mixture(num, 50)
    grid = torch.randn(50, n, requires_grad=True)
    exact = grid.detach().double().requires_grad_()
    found, expected = Interpolation(cells, weights, len(grid))(grid), plain(exact, cells, weights.double())
    cotangent = torch.randn(num, n)
    found.backward(cotangent)
    expected.backward(cotangent.double())
    assert grid.grad is not None and exact.grad is not None
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(grid.grad.double(), exact.grad, rtol=1e-5, atol=1e-5)


def test_the_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    mix = Interpolation(*mixture(3000, 40), num_cells=40)
    grid, cotangent = torch.randn(40, 8, requires_grad=True), torch.randn(3000, 8)
    results = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("AVATAR_THREADS", threads)
        values = mix(grid)
        results.append((values, *torch.autograd.grad(values, grid, cotangent)))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_strided_grid_and_cotangent() -> None:
    cells, weights = mixture(20, 9)
    wide = torch.randn(6, 9, requires_grad=True)
    cotangent = torch.randn(6, 20).T
    found = torch.autograd.grad(Interpolation(cells, weights, wide.shape[1])(wide.T), wide, cotangent)[0]
    torch.testing.assert_close(found, torch.autograd.grad(plain(wide.T, cells, weights), wide, cotangent)[0])


def test_float64_goes_through_torch() -> None:
    cells, weights = mixture(5, 4)
    grid = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda g: Interpolation(cells, weights, len(g))(g), (grid,))


def test_a_cell_that_nobody_mixes_has_zero_gradient() -> None:
    grid = torch.randn(3, 2, requires_grad=True)
    Interpolation(torch.tensor([[0, 0, 2, 2]]), torch.ones(1, 4), len(grid))(grid).sum().backward()
    assert grid.grad is not None and grid.grad.tolist() == [[2, 2], [0, 0], [2, 2]]


@pytest.mark.usefixtures("any_shapes")
def test_wrong_arguments_are_named() -> None:
    cells, weights = mixture(5, 4)
    with pytest.raises(ValueError, match=r"weights must have shape \[N, 4\], got \[5, 3\]"):
        Interpolation(cells, weights[:, :3], 4)
    with pytest.raises(TypeError, match="cells must be int64, got torch.int32"):
        Interpolation(cells.int(), weights, 4)
    with pytest.raises(TypeError, match="weights must be float32, got torch.float64"):
        Interpolation(cells, weights.double(), 4)
    with pytest.raises(ValueError, match=r"cells must be 0 to 3, got 4 at \[0, 1\]"):
        Interpolation(torch.tensor([[0, 4, 0, 0]]), torch.ones(1, 4), 4)
    with pytest.raises(ValueError, match=r"grid_values must have shape \[4, n\], got \[3, 2\]"):
        Interpolation(cells, weights, 4)(torch.zeros(3, 2))
