"""The compiled operators of the HyperGaussian head, float32 on a CPU, as autograd functions.

No Gaussian's result depends on another's, and a node's gradient is summed in the order of the Gaussians: the bits are the
same for any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.check import check_shapes
from avatar.native import instruction_set, thread_count

HEADS = {"position": 3, "rotation": 4, "scale": 3}  # and the number of values of each


def condition(latents: Float[Tensor, "N n"], parameters: Sequence[Float[Tensor, "..."]]) -> Float[Tensor, "N 10"]:
    """The raw offsets of all three heads, differentiable in everything; `avatar.gaussians.hyper` is the definition.

    parameters   `mean` [N, m + n], `lower` [N, m, m] and `cross` [N, n, m] of position, rotation and scale

    Raises TypeError or ValueError, naming the tensor, for a wrong shape, dtype or device. A value that is not finite
    shows in its own Gaussian's offsets and gradients and in no other's.
    """
    _check(latents, parameters)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (latents, *parameters)):
        return _Condition.apply(latents, *parameters)  # pyright: ignore
    return _forward(latents, parameters, None)


def _check(latents: Tensor, parameters: Sequence[Tensor]) -> None:
    check_shapes(latents=(latents, "N n"))
    N, n = latents.shape
    expected = {"latents": (N, n)}
    for head, m in HEADS.items():
        expected |= {f"{head}.mean": (N, m + n), f"{head}.lower": (N, m, m), f"{head}.cross": (N, n, m)}
    for (name, shape), tensor in zip(expected.items(), (latents, *parameters), strict=True):
        if tensor.shape != shape:
            raise ValueError(f"{name} must have shape {list(shape)} for these latents, got {list(tensor.shape)}")
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(f"{name} must be float32 on the cpu, got {tensor.dtype} on {tensor.device}")


def _forward(latents: Tensor, parameters: Sequence[Tensor], solved: Tensor | None) -> Tensor:
    offsets = torch.empty((len(latents), sum(HEADS.values())), dtype=torch.float32)
    latents, *inputs = (t.detach().contiguous() for t in (latents, *parameters))
    _core.hyper_forward(inputs, latents, instruction_set(), thread_count(), offsets, solved)
    return offsets


@torch.no_grad()
def apply_folded(
    matrix: Float[Tensor, "N n 10"], bias: Float[Tensor, "N 10"], latents: Float[Tensor, "N n"]
) -> Float[Tensor, "N 10"]:
    """bias + latents times matrix for each Gaussian. Float32 on the CPU is compiled, all else torch's own."""
    check_shapes(latents=(latents, "N n"), matrix=(matrix, "N n 10"), bias=(bias, "N 10"))
    if any(t.dtype != torch.float32 or t.device.type != "cpu" for t in (matrix, bias, latents)):
        return bias + (latents[:, None, :] @ matrix).squeeze(1)
    matrix, bias, latents = (t.detach().contiguous() for t in (matrix, bias, latents))
    offsets = torch.empty_like(bias)
    _core.hyper_apply(matrix, bias, latents, instruction_set(), thread_count(), offsets)
    return offsets


class _Condition(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latents: Tensor, *parameters: Tensor) -> Tensor:
        solved = torch.empty((len(latents), sum(HEADS.values())), dtype=torch.float32)
        ctx.save_for_backward(solved, latents, *parameters)
        return _forward(latents, parameters, solved)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        solved, latents, *parameters = (t.detach().contiguous() for t in ctx.saved_tensors)
        needed = ctx.needs_input_grad
        grad_latents = torch.empty_like(latents) if needed[0] else None
        gradients = _one_block(parameters) if any(needed[1:]) else None
        _core.hyper_backward(
            parameters,
            latents,
            solved,
            grad.contiguous(),
            instruction_set(),
            thread_count(),
            gradients,
            grad_latents,
        )
        everything = (grad_latents, *(gradients or [None] * len(parameters)))
        return tuple(gradient if wanted else None for gradient, wanted in zip(everything, needed, strict=True))


def _one_block(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Uninitialised tensors of the same shapes, side by side: one allocation."""
    parts = torch.empty(sum(t.numel() for t in tensors), dtype=torch.float32).split([t.numel() for t in tensors])
    return [part.view(t.shape) for part, t in zip(parts, tensors, strict=True)]


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
