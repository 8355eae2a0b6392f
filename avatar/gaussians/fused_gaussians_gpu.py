"""From the posed mesh and the network's values to Gaussians on a GPU: one launch, and two for the gradients."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.compute.device import to_device
from avatar.gaussians.hyper_cpu import Interpolation, Touching, packed_shape
from avatar.gaussians.skull_binding import SkullBinding
from avatar.head.model import matrix_from_6d
from avatar.kernels.fused_gaussians import fused_gaussians
from avatar.kernels.fused_gaussians_backward import fused_gaussians_backward, gather_nodes
from avatar.kernels.launch import start
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


def fused_gaussians_gpu(
    vertices: Float[Tensor, "V 3"],
    values: Float[Tensor, "M n"],
    packed: Float[Tensor, "blocks rows 16"] | None,
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    sh: Float[Tensor, "N K 3"],
    embedding: Mesh,
    grid: Interpolation | None,
    skull_binding: SkullBinding | None = None,
) -> Gaussians:
    """`apply_offsets` of the embedding's points and of the network's `values`, in one launch. Float32 tensors on one GPU.

    skull_binding  what brings the points to the skull (`bind_to_skull`), if anything does
    The values are brought from the grid's nodes to the Gaussians if there is a grid, and through the HyperGaussians
    `packed` if there are any.

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
    skull = neck = logits = None
    if skull_binding is not None:
        skull, logits, neck = skull_binding.skull, skull_binding.logits, to_device(skull_binding.neck, quats.device)
        check_shapes(quats=(quats, "N 4"), at_rest=(skull.at_rest, "N 3"), arms=(skull.arms, "N 3"))
        check_shapes(quats=(quats, "N 4"), neck=(neck, "6"), skull_logits=(logits, "N"))
    given = (vertices, neck, logits, values, packed, quats, log_scales, opacity_logits)
    placed: Any = _Fused.apply(*given, embedding, grid, skull)
    means, turned, scales, opacities = placed
    return Gaussians(means, turned, scales, opacities, sh)


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *given, embedding, grid, skull = arguments
        tensors: list[Any] = [None if t is None else t.detach().contiguous() for t in given]
        vertices, neck, logits, values, packed, quats, log_scales, opacity_logits = tensors
        N, n, has_skull = len(quats), values.shape[1], skull is not None
        is_hyper, saves = packed is not None, any(ctx.needs_input_grad)
        raw = torch.empty((N, 10), dtype=torch.float32, device=quats.device) if is_hyper and saves else values
        away = torch.empty_like(log_scales) if has_skull and saves else log_scales
        placed = [torch.empty_like(t) for t in (log_scales, quats, log_scales, opacity_logits)]
        cells, weights = (values, values) if grid is None else grid.corners
        start(
            fused_gaussians,
            -(-N // LANES),
            vertices,
            embedding.corners,
            embedding.barycentric,
            skull.at_rest if has_skull else vertices,
            skull.arms if has_skull else vertices,
            neck if has_skull else vertices,
            logits if has_skull else vertices,
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
            away,
            *placed,
            warps=LANES // 32,
            HAS_GRID=grid is not None,
            HAS_HYPER=is_hyper,
            HAS_SKULL=has_skull,
            SAVE=saves,
            BLOCK=LANES,
        )
        ctx.embedding, ctx.grid, ctx.skull, ctx.num_vertices = embedding, grid, skull, len(vertices)
        ctx.save_for_backward(values, packed, raw, away, neck, logits, quats, log_scales, placed[2], placed[3])
        return tuple(placed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Any, ...] = ctx.saved_tensors
        values, packed, raw, away, neck, logits, quats, log_scales, scales, opacities = saved
        grid: Interpolation | None = ctx.grid
        by_means, by_quats, by_scales, by_opacities = (gradient.contiguous() for gradient in upstream)
        N, n, is_hyper, has_skull = len(quats), values.shape[1], packed is not None, logits is not None
        own = values if grid is None else values.new_empty(N, n)  # the shape of each Gaussian's own values
        like = (own, packed if is_hyper else own, quats, log_scales, opacities, opacities)
        gradients = [torch.empty_like(t) for t in like]
        cells, weights = (values, values) if grid is None else grid.corners
        start(
            fused_gaussians_backward,
            -(-N // LANES),
            values,
            cells,
            weights,
            packed if is_hyper else values,
            raw,
            away,
            logits if has_skull else values,
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
            HAS_SKULL=has_skull,
            BLOCK=LANES,
        )
        by_values, by_packed, *by_base, by_logits = gradients
        if grid is not None:
            by_values = summed_at_nodes(grid.touching, by_values)
        by_vertices = by_neck = None
        needs_vertices, needs_neck = ctx.needs_input_grad[:2]
        on_skull = by_means * torch.sigmoid(logits)[:, None] if has_skull and (needs_vertices or needs_neck) else None
        if on_skull is not None and needs_neck:
            by_neck = _neck_gradient(neck, on_skull.T @ ctx.skull.arms)
        if needs_vertices:
            on_mesh = by_means if on_skull is None else by_means - on_skull
            by_vertices = summed_at_nodes(ctx.embedding.touching(ctx.num_vertices), on_mesh)
        by_logits = by_logits if has_skull else None
        by_packed = by_packed if is_hyper else None
        return by_vertices, by_neck, by_logits, by_values, by_packed, *by_base, None, None, None


def _neck_gradient(neck: Float[Tensor, " 6"], by_turn: Float[Tensor, "3 3"]) -> Float[Tensor, " 6"]:
    with torch.enable_grad():
        leaf = neck.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(matrix_from_6d(leaf).mT, leaf, by_turn)
    return gradient


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
