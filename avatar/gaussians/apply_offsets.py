"""Offsets applied to the Gaussians on the posed mesh: what is splatted.

Source: FlashAvatar; its two quirks are kept, because the learning rates and the published figures belong to them: the
rotation offset is (exp(r0), r1, r2, r3), and the scale offset multiplies the LOG-scale.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from avatar.gaussians.apply_offsets_cpu import apply_offsets_cpu
from avatar.tensors import check_shapes
from avatar.types import Gaussians


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


def apply_offsets(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    sh: Float[Tensor, "N K 3"],
    raw: Float[Tensor, "N 10"],
) -> Gaussians:
    """Points of the posed mesh, base parameters and ten raw offsets per Gaussian -> activated Gaussians in world space.

    raw   position (3, metres), rotation (4) and scale (3), each bounded by a tanh
    Float32 tensors on the CPU take the compiled kernel. Raises ValueError for tensors whose sizes disagree.
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
        return Gaussians(*apply_offsets_cpu(*tensors), sh)
    position, rotation, scale = torch.tanh(raw).split((3, 4, 3), dim=-1)
    delta = torch.cat((torch.exp(rotation[:, :1]), rotation[:, 1:]), dim=-1)
    return Gaussians(
        means=points + position,
        quats=normalize(quaternion_product(normalize(quats, dim=-1), delta), dim=-1),
        scales=torch.exp(log_scales * torch.exp(scale)),
        opacities=torch.sigmoid(opacity_logits),
        sh=sh,
    )
