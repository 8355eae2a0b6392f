"""The compiled operators of the HyperGaussian head, float32 on a CPU, as autograd functions.

No Gaussian's result depends on another's, and a node's gradient is summed in the order of the Gaussians: the bits are the
same for any number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar import _core
from avatar.compute.native import instruction_set, thread_count
from avatar.tensors import check_shapes

HEADS = {"position": 3, "rotation": 4, "scale": 3}  # and the number of values of each
OFFSETS = sum(HEADS.values())
BLOCK = 16  # Gaussians side by side in the parameters
# Rows of a block that there are once, means and triangles, and rows for every latent dimension.
CONSTANTS = sum(m + m * (m + 1) // 2 for m in HEADS.values())
DIMENSION = sum(1 + m for m in HEADS.values())


def packed_shape(num_gaussians: int, latent_size: int) -> tuple[int, int, int]:
    """The shape of all heads' parameters in one tensor; `avatar.gaussians.hyper.pack` says what is where."""
    return -(-num_gaussians // BLOCK), CONSTANTS + latent_size * DIMENSION, BLOCK


def condition(latents: Float[Tensor, "N n"], packed: Float[Tensor, "blocks rows 16"]) -> Float[Tensor, "N 10"]:
    """The raw offsets of all three heads, differentiable in everything; `avatar.gaussians.hyper` is the definition.

    Raises TypeError or ValueError, naming the tensor, for a wrong shape, dtype or device. A value that is not finite
    shows in its own Gaussian's offsets and gradients and in no other's.
    """
    for name, tensor in (("latents", latents), ("packed", packed)):
        if tensor.dtype is not torch.float32 or not tensor.is_cpu:
            raise TypeError(f"{name} must be float32 on the cpu, got {tensor.dtype} on {tensor.device}")
    if latents.ndim != 2:
        raise ValueError(f"latents must have shape [N, n], got {list(latents.shape)}")
    latents, packed = latents.contiguous(), packed.contiguous()
    if torch.is_grad_enabled() and (latents.requires_grad or packed.requires_grad):
        return _Condition.apply(latents, packed)  # pyright: ignore
    return _forward(latents, packed, None)


def _forward(latents: Tensor, packed: Tensor, solved: Tensor | None) -> Tensor:
    offsets = torch.empty((latents.shape[0], OFFSETS), dtype=torch.float32)
    _core.hyper_forward(packed.detach(), latents.detach(), instruction_set(), thread_count(), offsets, solved)
    return offsets


class _Condition(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latents: Tensor, packed: Tensor) -> Tensor:
        solved = torch.empty((packed.shape[0], OFFSETS, BLOCK), dtype=torch.float32)
        ctx.save_for_backward(solved, latents, packed)
        return _forward(latents, packed, solved)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:  # pyright: ignore
        solved, latents, packed = ctx.saved_tensors
        latents, packed, simd, threads = latents.detach(), packed.detach(), instruction_set(), thread_count()
        by_latents, by_packed = ctx.needs_input_grad
        grad_latents = torch.empty_like(latents) if by_latents else None
        gradient = _core.hyper_backward(
            packed, latents, solved, grad.contiguous(), simd, threads, by_packed, grad_latents
        )
        return grad_latents, gradient


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


class Touching(NamedTuple):
    """For each place the Gaussians that take part of it, place by place, in the order of the Gaussians."""

    begins: Int[Tensor, " M+1"]  # of each place's list
    gaussians: Int[Tensor, " E"]  # int32
    weights: Float[Tensor, " E"]


def touching_lists(cells: Int[Tensor, "N k"], weights: Float[Tensor, "N k"], num_cells: int) -> Touching:
    """The lists of `num_cells` places, of which each Gaussian takes part of k."""
    flat, order = cells.reshape(-1), torch.argsort(cells.reshape(-1), stable=True)
    ends = torch.bincount(flat, minlength=num_cells).cumsum(0)
    begins = torch.cat((cells.new_zeros(1), ends))
    return Touching(begins, (order // cells.shape[1]).int(), weights.reshape(-1)[order])


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
        self.corners = self.cells.int(), self.weights
        self.touching = touching_lists(self.cells, self.weights, num_cells)

    def __call__(self, grid_values: Float[Tensor, "G n"]) -> Float[Tensor, "N n"]:
        """The mixed values. Float32 on the CPU goes through the kernel, all else through torch's own operations."""
        check_shapes(grid_values=(grid_values, f"{self.num_cells} n"))
        if grid_values.dtype == torch.float32 and grid_values.device.type == "cpu":
            return _Interpolate.apply(grid_values, self.corners, self.touching)  # pyright: ignore
        weights = self.weights.to(grid_values)
        return (grid_values[self.cells.to(grid_values.device)] * weights[..., None]).sum(dim=1)

    def move(self, device: torch.device) -> None:
        """Bring it to where the values are to be."""
        self.cells, self.weights = self.cells.to(device), self.weights.to(device)
        self.corners = self.corners[0].to(device), self.weights
        self.touching = Touching(*(tensor.to(device) for tensor in self.touching))


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        grid_values: Tensor,
        corners: tuple[Tensor, Tensor],
        touching: Touching,
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
        touching: Touching = ctx.touching
        _core.interpolate_backward(grad.contiguous(), *touching, instruction_set(), thread_count(), grad_grid)
        return grad_grid, None, None
