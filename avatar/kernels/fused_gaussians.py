"""From the mesh and the network's values to Gaussians, in one launch, one lane for each Gaussian.

What `Embedding.points`, `bind_to_skull`, `Interpolation`, `HyperHeads` and `apply_offsets` do one after the other; they
are the definition.
"""

import triton
import triton.language as tl

from avatar.kernels.activations import normalized, product, sigmoid, tanh
from avatar.kernels.hyper import (
    CONSTANTS,
    DIMENSION,
    POSITION_FACTOR,
    ROTATION_FACTOR,
    SCALE_FACTOR,
    first_row,
    mixed,
    row,
    solve3_upper,
    solve4_upper,
)
from avatar.kernels.load_store import load3, load4, load10, store3, store4, store10
from avatar.kernels.pose import matrix_of_6d, rotated


@triton.jit
def conditional_means(nodes, cells, weights, packed, i, latents, HAS_GRID: tl.constexpr, mask):
    """The ten raw offsets: mu_a - L11^-T L21^T (z - mu_b) of each head."""
    values = first_row(packed, i, latents)
    zero = tl.zeros_like(i).to(tl.float32)
    p0, p1, p2, p3, p4, p5, p6, p7, p8, p9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for d in range(latents):
        z = mixed(nodes, cells, weights, i, latents, d, HAS_GRID, mask)
        at = CONSTANTS + DIMENSION * d
        from_mean = z - row(values, at, mask)
        p0 += from_mean * row(values, at + 1, mask)
        p1 += from_mean * row(values, at + 2, mask)
        p2 += from_mean * row(values, at + 3, mask)
        from_mean = z - row(values, at + 4, mask)
        p3 += from_mean * row(values, at + 5, mask)
        p4 += from_mean * row(values, at + 6, mask)
        p5 += from_mean * row(values, at + 7, mask)
        p6 += from_mean * row(values, at + 8, mask)
        from_mean = z - row(values, at + 9, mask)
        p7 += from_mean * row(values, at + 10, mask)
        p8 += from_mean * row(values, at + 11, mask)
        p9 += from_mean * row(values, at + 12, mask)
    p0, p1, p2 = solve3_upper(values, POSITION_FACTOR, p0, p1, p2, mask)
    p3, p4, p5, p6 = solve4_upper(values, ROTATION_FACTOR, p3, p4, p5, p6, mask)
    p7, p8, p9 = solve3_upper(values, SCALE_FACTOR, p7, p8, p9, mask)
    p0, p1, p2 = row(values, 0, mask) - p0, row(values, 1, mask) - p1, row(values, 2, mask) - p2
    p3, p4 = row(values, 3, mask) - p3, row(values, 4, mask) - p4
    p5, p6 = row(values, 5, mask) - p5, row(values, 6, mask) - p6
    p7, p8, p9 = row(values, 7, mask) - p7, row(values, 8, mask) - p8, row(values, 9, mask) - p9
    return p0, p1, p2, p3, p4, p5, p6, p7, p8, p9


@triton.jit
def point_on_mesh(vertices, corners, barycentric, i, mask):
    """Gaussian i's point on its triangle of the posed mesh."""
    x, y, z = tl.zeros_like(i).to(tl.float32), tl.zeros_like(i).to(tl.float32), tl.zeros_like(i).to(tl.float32)
    for corner in tl.static_range(3):
        vertex = tl.load(corners + 3 * i + corner, mask=mask, other=0)
        share = tl.load(barycentric + 3 * i + corner, mask=mask, other=0.0)
        v_x, v_y, v_z = load3(vertices, vertex, mask)
        x += share * v_x
        y += share * v_y
        z += share * v_z
    return x, y, z


@triton.jit
def turned(quats, i, r0, r1, r2, r3, mask):
    """The base rotation and, after it, the offset (exp(r0), r1, r2, r3), each a quaternion as `normalized` gives it."""
    w, x, y, z = load4(quats, i, mask)
    bw, bx, by, bz, inverse, is_long = normalized(w, x, y, z)
    w, x, y, z = product(bw, bx, by, bz, tl.exp(r0), r1, r2, r3)
    tw, tx, ty, tz, turned_inverse, turned_is_long = normalized(w, x, y, z)
    return bw, bx, by, bz, inverse, is_long, tw, tx, ty, tz, turned_inverse, turned_is_long


@triton.jit(do_not_specialize=["count", "latents"])
def fused_gaussians(
    vertices,
    corners,
    barycentric,
    at_rest,
    arms,
    neck,
    skull_logits,
    nodes,
    cells,
    weights,
    packed,
    quats,
    log_scales,
    opacity_logits,
    count,
    latents,
    raw,
    away,
    means,
    out_quats,
    scales,
    opacities,
    HAS_GRID: tl.constexpr,
    HAS_HYPER: tl.constexpr,
    HAS_SKULL: tl.constexpr,
    SAVE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write means, quats, scales and opacities of all Gaussians and, with SAVE, what the gradients take: their ten raw
    offsets [N, 10] and, with HAS_SKULL, how far their points on the skull are `away` from those on the mesh [N, 3].

    vertices [V, 3]; corners int32 [N, 3], barycentric [N, 3]; with HAS_SKULL, at_rest and arms [N, 3] of the skull, the
    6D rotation `neck`, whose inverse turns it, and skull_logits [N];
    nodes [M, latents] with cells int32 [N, 4] and weights [N, 4], or, without HAS_GRID, [N, latents]; packed: see `hyper`.
    Without HAS_HYPER the network's values are the offsets.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    if HAS_HYPER:
        o0, o1, o2, o3, o4, o5, o6, o7, o8, o9 = conditional_means(
            nodes, cells, weights, packed, i, latents, HAS_GRID, here
        )
        if SAVE:
            store10(raw, i, o0, o1, o2, o3, o4, o5, o6, o7, o8, o9, here)
    else:
        o0, o1, o2, o3, o4, o5, o6, o7, o8, o9 = load10(nodes, i, here)
    x, y, z = point_on_mesh(vertices, corners, barycentric, i, here)
    if HAS_SKULL:
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = matrix_of_6d(neck)
        a_x, a_y, a_z = load3(arms, i, here)
        a_x, a_y, a_z = rotated(r0 - 1.0, r3, r6, r1, r4 - 1.0, r7, r2, r5, r8 - 1.0, a_x, a_y, a_z)
        n_x, n_y, n_z = load3(at_rest, i, here)
        a_x, a_y, a_z = n_x + a_x - x, n_y + a_y - y, n_z + a_z - z
        if SAVE:
            store3(away, i, a_x, a_y, a_z, here)
        share = sigmoid(tl.load(skull_logits + i, mask=here, other=0.0))
        x, y, z = x + share * a_x, y + share * a_y, z + share * a_z
    store3(means, i, x + tanh(o0), y + tanh(o1), z + tanh(o2), here)
    _, _, _, _, _, _, w, x, y, z, _, _ = turned(quats, i, tanh(o3), tanh(o4), tanh(o5), tanh(o6), here)
    store4(out_quats, i, w, x, y, z, here)
    s0, s1, s2 = load3(log_scales, i, here)
    s0, s1, s2 = s0 * tl.exp(tanh(o7)), s1 * tl.exp(tanh(o8)), s2 * tl.exp(tanh(o9))
    store3(scales, i, tl.exp(s0), tl.exp(s1), tl.exp(s2), here)
    tl.store(opacities + i, sigmoid(tl.load(opacity_logits + i, mask=here, other=0.0)), mask=here)
