"""From the posed mesh and the network's values to Gaussians on a GPU: one launch, and two for the gradients."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.gaussians.hyper_cpu import Interpolation, Touching, packed_shape
from avatar.kernels.place import place
from avatar.kernels.place_backward import gather_nodes, place_backward
from avatar.kernels.start import start
from avatar.tensors import check_shapes
from avatar.types import Gaussians

LANES = 128  # Gaussians of a program; a multiple of the 16 that lie side by side in the heads' parameters
ENTRIES = 32  # of a node's list that are summed at a time
WIDEST = 64  # values of a node that one program sums


class Mesh(Protocol):
    """How Gaussians hang on a mesh; an `Embedding`."""

    corners: Int[Tensor, "N 3"]
    barycentric: Float[Tensor, "N 3"]

    def touching(self, num_vertices: int) -> Touching: ...


def place_gpu(
    vertices: Float[Tensor, "V 3"],
    values: Float[Tensor, "M n"],
    packed: Float[Tensor, "blocks rows 16"] | None,
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    sh: Float[Tensor, "N K 3"],
    embedding: Mesh,
    grid: Interpolation | None,
) -> Gaussians:
    """`compose_raw` of the embedding's points and of the network's `values`, which are brought from the grid's nodes to the
    Gaussians if there is a grid and through the HyperGaussians `packed` if there are any. Float32 tensors on one GPU.

    Differentiable in all tensors. Raises ValueError for tensors whose sizes disagree.
    """
    N, n = len(quats), values.shape[-1]
    check_shapes(vertices=(vertices, "V 3"), quats=(quats, "N 4"), log_scales=(log_scales, "N 3"))
    check_shapes(quats=(quats, "N 4"), opacity_logits=(opacity_logits, "N"), sh=(sh, "N _ 3"))
    places = N if grid is None else grid.num_cells
    check_shapes(values=(values, f"{places} {'n' if packed is not None else 10}"))
    if len(embedding.corners) != N:
        raise ValueError(f"quats has N = {N}, but the embedding has {len(embedding.corners)} Gaussians")
    if packed is not None and tuple(packed.shape) != packed_shape(N, n):
        raise ValueError(f"packed must have shape {list(packed_shape(N, n))}, got {list(packed.shape)}")
    if packed is None and grid is not None:
        raise ValueError("offsets are not smooth over the map: there is no grid without HyperGaussians")
    given = (vertices, values, packed, quats, log_scales, opacity_logits)
    placed: Any = _Place.apply(*given, embedding, grid)
    means, turned, scales, opacities = placed
    return Gaussians(means, turned, scales, opacities, sh)


class _Place(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *given, embedding, grid = arguments
        tensors: list[Any] = [None if t is None else t.detach().contiguous() for t in given]
        vertices, values, packed, quats, log_scales, opacity_logits = tensors
        N, n = len(quats), values.shape[1]
        is_hyper, saves = packed is not None, any(ctx.needs_input_grad)
        raw = torch.empty((N, 10), dtype=torch.float32, device=quats.device) if is_hyper and saves else values
        placed = [torch.empty_like(t) for t in (log_scales, quats, log_scales, opacity_logits)]
        cells, weights = (values, values) if grid is None else grid.corners
        start(
            place,
            -(-N // LANES),
            vertices,
            embedding.corners,
            embedding.barycentric,
            values,
            cells,
            weights,
            packed if is_hyper else values,
            quats,
            log_scales,
            opacity_logits,
            N,
            n,
            raw,
            *placed,
            warps=LANES // 32,
            HAS_GRID=grid is not None,
            HAS_HYPER=is_hyper,
            SAVE=saves,
            BLOCK=LANES,
        )
        ctx.embedding, ctx.grid, ctx.num_vertices = embedding, grid, len(vertices)
        ctx.save_for_backward(values, packed, raw, quats, log_scales, placed[2], placed[3])
        return tuple(placed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Any, ...] = ctx.saved_tensors
        values, packed, raw, quats, log_scales, scales, opacities = saved
        grid: Interpolation | None = ctx.grid
        by_means, by_quats, by_scales, by_opacities = (gradient.contiguous() for gradient in upstream)
        N, n, is_hyper = len(quats), values.shape[1], packed is not None
        own = values if grid is None else values.new_empty(N, n)  # the shape of each Gaussian's own values
        gradients = [torch.empty_like(t) for t in (own, packed if is_hyper else own, quats, log_scales, opacities)]
        cells, weights = (values, values) if grid is None else grid.corners
        start(
            place_backward,
            -(-N // LANES),
            values,
            cells,
            weights,
            packed if is_hyper else values,
            raw,
            quats,
            log_scales,
            scales,
            opacities,
            by_means,
            by_quats,
            by_scales,
            by_opacities,
            N,
            n,
            *gradients,
            warps=LANES // 32,
            HAS_GRID=grid is not None,
            HAS_HYPER=is_hyper,
            BLOCK=LANES,
        )
        by_values, by_packed, *by_base = gradients
        if grid is not None:
            by_values = summed_at_nodes(grid.touching, by_values)
        by_vertices = None
        if ctx.needs_input_grad[0]:
            by_vertices = summed_at_nodes(ctx.embedding.touching(ctx.num_vertices), by_means)
        return by_vertices, by_values, by_packed if is_hyper else None, *by_base, None, None


def summed_at_nodes(lists: Touching, gradients: Float[Tensor, "N w"]) -> Float[Tensor, "M w"]:
    """For each node the weighted sum over the Gaussians that take part of it, in a fixed order."""
    nodes, width = len(lists.begins) - 1, gradients.shape[1]
    at_once = min(1 << (width - 1).bit_length(), WIDEST)
    parts = -(-width // at_once)
    out = torch.empty((nodes, width), dtype=torch.float32, device=gradients.device)
    start(
        gather_nodes,
        nodes * parts,
        lists.begins,
        lists.gaussians,
        lists.weights,
        gradients,
        parts,
        width,
        out,
        warps=1,
        LANES=ENTRIES,
        WIDTH=at_once,
    )
    return out
