"""The compiled operators of the HyperGaussian head, float32 on a CPU, as autograd functions.

No Gaussian's result depends on another's, and a node's gradient is summed in the order of the Gaussians: the bits are the
same for any number of threads.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.check import check_shapes
from avatar.native import instruction_set, thread_count


def interpolate(
    grid_values: Float[Tensor, "G n"], cells: Int[Tensor, "N 4"], weights: Float[Tensor, "N 4"]
) -> Float[Tensor, "N n"]:
    """(grid_values[cells] * weights[..., None]).sum(1), differentiable in `grid_values`.

    For more than one call with the same cells an `Interpolation` does the sorting for the backward pass only once.
    """
    return Interpolation(cells, weights, len(grid_values))(grid_values)


class Interpolation:
    """Values at `num_cells` places, four of which are mixed for each of N Gaussians.

    Raises TypeError or ValueError, naming the argument, for a wrong type, shape or dtype and for a cell that is not there.
    """

    def __init__(self, cells: Int[Tensor, "N 4"], weights: Float[Tensor, "N 4"], num_cells: int) -> None:
        check_shapes(cells=(cells, "N 4"), weights=(weights, "N 4"))
        if cells.dtype != torch.int64:
            raise TypeError(f"cells must be int64, got {cells.dtype}")
        if weights.dtype != torch.float32:
            raise TypeError(f"weights must be float32, got {weights.dtype}")
        if not 0 <= num_cells < 2**31 or cells.numel() >= 2**31:
            raise ValueError(f"at most 2^31 - 1 cells and corners can be mixed, got {num_cells} and {cells.numel()}")
        outside = (cells < 0) | (cells >= num_cells)
        if bool(outside.any()):
            first = outside.nonzero()[0].tolist()
            raise ValueError(f"cells must be 0 to {num_cells - 1}, got {int(cells[tuple(first)])} at {first}")
        self.num_cells = num_cells
        self.cells, self.weights = cells.contiguous(), weights.detach().contiguous()
        by_cell = torch.argsort(cells.reshape(-1), stable=True)
        self._corners = self.cells.int(), self.weights
        self._touching = (
            torch.cat((cells.new_zeros(1), torch.bincount(cells.reshape(-1), minlength=num_cells).cumsum(0))),
            (by_cell // 4).int(),
            self.weights.reshape(-1)[by_cell],
        )

    def __call__(self, grid_values: Float[Tensor, "G n"]) -> Float[Tensor, "N n"]:
        """The mixed values. Float32 on the CPU goes through the kernel, all else through torch's own operations."""
        check_shapes(grid_values=(grid_values, f"{self.num_cells} n"))
        if grid_values.dtype == torch.float32 and grid_values.device.type == "cpu":
            return _Interpolate.apply(grid_values, self._corners, self._touching)  # pyright: ignore
        weights = self.weights.to(grid_values)
        return (grid_values[self.cells.to(grid_values.device)] * weights[..., None]).sum(dim=1)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        grid_values: Tensor,
        corners: tuple[Tensor, Tensor],
        touching: tuple[Tensor, Tensor, Tensor],
    ) -> Tensor:
        ctx.shape, ctx.touching = grid_values.shape, touching
        out = torch.empty((len(corners[0]), grid_values.shape[1]), dtype=torch.float32)
        grid = grid_values.detach().contiguous()
        _core.interpolate_forward(grid, *corners, instruction_set(), thread_count(), out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore
        grad_grid = torch.empty(ctx.shape, dtype=torch.float32)
        touching: tuple[Tensor, Tensor, Tensor] = ctx.touching
        _core.interpolate_backward(grad.contiguous(), *touching, instruction_set(), thread_count(), grad_grid)
        return grad_grid, None, None
