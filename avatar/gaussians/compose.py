"""From points on the mesh, per-Gaussian parameters and offsets to what is splatted.

Source: FlashAvatar; its two quirks are kept, because the learning rates and the published figures belong to them: the
rotation offset is (exp(r0), r1, r2, r3), and the scale offset multiplies the LOG-scale.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.compose_cpu import compose_cpu
from avatar.tensors import check_shapes
from avatar.types import Gaussians, Offsets


def split_offsets(raw: Float[Tensor, "N 10"]) -> Offsets:
    """Ten raw values per Gaussian -> bounded offsets, through tanh."""
    position, rotation, scale = torch.tanh(raw).split((3, 4, 3), dim=-1)
    return Offsets(position, rotation, scale)


def quaternion_product(a: Float[Tensor, "*B 4"], b: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 4"]:
    """Hamilton product a b, (w, x, y, z)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def compose(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    sh: Float[Tensor, "N K 3"],
    offsets: Offsets,
) -> Gaussians:
    """Points [N, 3] of the posed mesh, base parameters and offsets -> activated Gaussians in world space."""
    delta = torch.cat((torch.exp(offsets.rotation[:, :1]), offsets.rotation[:, 1:]), dim=-1)
    base = torch.nn.functional.normalize(quats, dim=-1)
    return Gaussians(
        means=points + offsets.position,
        quats=torch.nn.functional.normalize(quaternion_product(base, delta), dim=-1),
        scales=torch.exp(log_scales * torch.exp(offsets.scale)),
        opacities=torch.sigmoid(opacity_logits),
        sh=sh,
    )


def compose_raw(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    sh: Float[Tensor, "N K 3"],
    raw: Float[Tensor, "N 10"],
) -> Gaussians:
    """`compose` with `split_offsets(raw)`; float32 tensors on the CPU take the compiled kernel, which does both at once.

    Raises ValueError for tensors whose sizes disagree.
    """
    check_shapes(
        points=(points, "N 3"),
        quats=(quats, "N 4"),
        log_scales=(log_scales, "N 3"),
        opacity_logits=(opacity_logits, "N"),
        sh=(sh, "N _ 3"),
        raw=(raw, "N 10"),
    )
    tensors = (points, quats, log_scales, opacity_logits, raw)
    if all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors):
        return Gaussians(*compose_cpu(*tensors), sh)
    return compose(points, quats, log_scales, opacity_logits, sh, split_offsets(raw))
