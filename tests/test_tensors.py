"""Rows of tensors."""

from __future__ import annotations

import pytest
import torch

from avatar.tensors import take_rows


@pytest.mark.parametrize(("shape", "dim"), [((7,), 0), ((7, 3), 0), ((4, 7), -1), ((2, 7, 3), 1)])
@pytest.mark.parametrize("of_rows", [(5,), (4, 3)])
def test_rows_are_those_of_an_index(shape: tuple[int, ...], dim: int, of_rows: tuple[int, ...]) -> None:
    values, rows = torch.randn(shape, dtype=torch.float64, requires_grad=True), torch.randint(7, of_rows)
    assert torch.equal(take_rows(values, rows, dim), values[(slice(None),) * (dim % len(shape)) + (rows,)])
    assert torch.autograd.gradcheck(lambda v: take_rows(v, rows, dim), values)


def test_gradients_of_rows_taken_again_have_the_same_bits(two_threads: None) -> None:
    values, rows = torch.randn(2000, 3, requires_grad=True), torch.randint(2000, (200_000,))
    of_rows = torch.randn(len(rows), 3)

    def gradient() -> torch.Tensor:
        return torch.autograd.grad(take_rows(values, rows), values, of_rows)[0]

    first = gradient()
    assert all(torch.equal(first, gradient()) for _ in range(10))
