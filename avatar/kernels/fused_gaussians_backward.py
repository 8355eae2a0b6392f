"""The gradients of `fused_gaussians`: of the parameters in one launch, of the values at the nodes in another."""

import triton
import triton.language as tl

from avatar.kernels.activations import normalized_backward, product, sigmoid, tanh, tanh_slope
from avatar.kernels.fused_gaussians import turned
from avatar.kernels.hyper import (
    CONSTANTS,
    DIMENSION,
    PACKED,
    POSITION_FACTOR,
    ROTATION_FACTOR,
    SCALE_FACTOR,
    first_row,
    mixed,
    row,
    solve3_lower,
    solve4_lower,
)
from avatar.kernels.load_store import load3, load4, load10, store3, store4, store10


@triton.jit
def _put(values, k, gradient, mask):
    tl.store(values + PACKED * k, gradient, mask=mask)


@triton.jit
def _factor3(values, grads, FACTOR: tl.constexpr, s0, s1, s2, q0, q1, q2, mask, all_lanes):
    """The factor L's gradient is -s q^T; its diagonal is stored as logarithms."""
    _put(grads, FACTOR, -s0 * q0 * tl.exp(row(values, FACTOR, mask)), all_lanes)
    _put(grads, FACTOR + 1, -s1 * q0, all_lanes)
    _put(grads, FACTOR + 2, -s1 * q1 * tl.exp(row(values, FACTOR + 2, mask)), all_lanes)
    _put(grads, FACTOR + 3, -s2 * q0, all_lanes)
    _put(grads, FACTOR + 4, -s2 * q1, all_lanes)
    _put(grads, FACTOR + 5, -s2 * q2 * tl.exp(row(values, FACTOR + 5, mask)), all_lanes)


@triton.jit
def _factor4(values, grads, FACTOR: tl.constexpr, s0, s1, s2, s3, q0, q1, q2, q3, mask, all_lanes):
    _factor3(values, grads, FACTOR, s0, s1, s2, q0, q1, q2, mask, all_lanes)
    _put(grads, FACTOR + 6, -s3 * q0, all_lanes)
    _put(grads, FACTOR + 7, -s3 * q1, all_lanes)
    _put(grads, FACTOR + 8, -s3 * q2, all_lanes)
    _put(grads, FACTOR + 9, -s3 * q3 * tl.exp(row(values, FACTOR + 9, mask)), all_lanes)


@triton.jit
def heads_backward(
    nodes,
    cells,
    weights,
    packed,
    raw,
    i,
    latents,
    by0,
    by1,
    by2,
    by3,
    by4,
    by5,
    by6,
    by7,
    by8,
    by9,
    grad_values,
    grad_packed,
    HAS_GRID: tl.constexpr,
    mask,
    all_lanes,
):
    """Write the gradients of the heads and of each Gaussian's latent, from those of its raw offsets.

    With s = mu_a - offset, L^T s = p and q = -L^-1 (dL/d offset): dL/dp = q, dL/dL = -s q^T.
    """
    values, grads = first_row(packed, i, latents), first_row(grad_packed, i, latents)
    _put(grads, 0, by0, all_lanes)
    _put(grads, 1, by1, all_lanes)
    _put(grads, 2, by2, all_lanes)
    _put(grads, 3, by3, all_lanes)
    _put(grads, 4, by4, all_lanes)
    _put(grads, 5, by5, all_lanes)
    _put(grads, 6, by6, all_lanes)
    _put(grads, 7, by7, all_lanes)
    _put(grads, 8, by8, all_lanes)
    _put(grads, 9, by9, all_lanes)
    q0, q1, q2 = solve3_lower(values, POSITION_FACTOR, -by0, -by1, -by2, mask)
    q3, q4, q5, q6 = solve4_lower(values, ROTATION_FACTOR, -by3, -by4, -by5, -by6, mask)
    q7, q8, q9 = solve3_lower(values, SCALE_FACTOR, -by7, -by8, -by9, mask)
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9 = load10(raw, i, mask)
    s0, s1, s2 = row(values, 0, mask) - s0, row(values, 1, mask) - s1, row(values, 2, mask) - s2
    _factor3(values, grads, POSITION_FACTOR, s0, s1, s2, q0, q1, q2, mask, all_lanes)
    s3, s4 = row(values, 3, mask) - s3, row(values, 4, mask) - s4
    s5, s6 = row(values, 5, mask) - s5, row(values, 6, mask) - s6
    _factor4(values, grads, ROTATION_FACTOR, s3, s4, s5, s6, q3, q4, q5, q6, mask, all_lanes)
    s7, s8, s9 = row(values, 7, mask) - s7, row(values, 8, mask) - s8, row(values, 9, mask) - s9
    _factor3(values, grads, SCALE_FACTOR, s7, s8, s9, q7, q8, q9, mask, all_lanes)

    for d in range(latents):
        z = mixed(nodes, cells, weights, i, latents, d, HAS_GRID, mask)
        at = CONSTANTS + DIMENSION * d
        from_mean = z - row(values, at, mask)
        by_position = q0 * row(values, at + 1, mask) + q1 * row(values, at + 2, mask) + q2 * row(values, at + 3, mask)
        _put(grads, at, -by_position, all_lanes)
        _put(grads, at + 1, q0 * from_mean, all_lanes)
        _put(grads, at + 2, q1 * from_mean, all_lanes)
        _put(grads, at + 3, q2 * from_mean, all_lanes)
        from_mean = z - row(values, at + 4, mask)
        by_rotation = q3 * row(values, at + 5, mask) + q4 * row(values, at + 6, mask)
        by_rotation += q5 * row(values, at + 7, mask) + q6 * row(values, at + 8, mask)
        _put(grads, at + 4, -by_rotation, all_lanes)
        _put(grads, at + 5, q3 * from_mean, all_lanes)
        _put(grads, at + 6, q4 * from_mean, all_lanes)
        _put(grads, at + 7, q5 * from_mean, all_lanes)
        _put(grads, at + 8, q6 * from_mean, all_lanes)
        from_mean = z - row(values, at + 9, mask)
        by_scale = q7 * row(values, at + 10, mask) + q8 * row(values, at + 11, mask) + q9 * row(values, at + 12, mask)
        _put(grads, at + 9, -by_scale, all_lanes)
        _put(grads, at + 10, q7 * from_mean, all_lanes)
        _put(grads, at + 11, q8 * from_mean, all_lanes)
        _put(grads, at + 12, q9 * from_mean, all_lanes)
        tl.store(grad_values + i * latents + d, by_position + by_rotation + by_scale, mask=mask)


@triton.jit(do_not_specialize=["count", "latents"])
def fused_gaussians_backward(
    nodes,
    cells,
    weights,
    packed,
    raw,
    away,
    skull_logits,
    quats,
    log_scales,
    scales,
    opacities,
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    count,
    latents,
    out_values,
    out_packed,
    out_quats,
    out_log_scales,
    out_logits,
    out_skull_logits,
    HAS_GRID: tl.constexpr,
    HAS_HYPER: tl.constexpr,
    HAS_SKULL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the gradients `out_...` of what `fused_gaussians` takes from those of what it gives.

    raw float32 [N, 10] and, with HAS_SKULL, away [N, 3]: what `fused_gaussians` saved;  out_values [N, latents]: of each
    Gaussian's own latent (without HAS_HYPER: of its offsets, [N, 10]), before `gather_nodes` brings them to the nodes.
    The gradient of the means is that of the mesh's points, with HAS_SKULL of those and the skull's by their shares. In
    `out_packed`, lanes that stand for no Gaussian are written too, with zeros.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    t0, t1, t2, t3, t4, t5, t6, t7, t8, t9 = load10(raw, i, here)
    t0, t1, t2, t3, t4 = tanh(t0), tanh(t1), tanh(t2), tanh(t3), tanh(t4)
    t5, t6, t7, t8, t9 = tanh(t5), tanh(t6), tanh(t7), tanh(t8), tanh(t9)

    by0, by1, by2 = load3(grad_means, i, here)
    if HAS_SKULL:
        a_x, a_y, a_z = load3(away, i, here)
        share = sigmoid(tl.load(skull_logits + i, mask=here, other=0.0))
        by_share = by0 * a_x + by1 * a_y + by2 * a_z
        tl.store(out_skull_logits + i, by_share * share * (1.0 - share), mask=here)
    bw, bx, by, bz, inverse, is_long, tw, tx, ty, tz, turned_inverse, turned_is_long = turned(
        quats, i, t3, t4, t5, t6, here
    )
    gw, gx, gy, gz = load4(grad_quats, i, here)
    gw, gx, gy, gz = normalized_backward(tw, tx, ty, tz, turned_inverse, turned_is_long, gw, gx, gy, gz)
    grown = tl.exp(t3)
    by3, by4, by5, by6 = product(bw, -bx, -by, -bz, gw, gx, gy, gz)
    by3 = by3 * grown
    gw, gx, gy, gz = product(gw, gx, gy, gz, grown, -t4, -t5, -t6)
    gw, gx, gy, gz = normalized_backward(bw, bx, by, bz, inverse, is_long, gw, gx, gy, gz)
    store4(out_quats, i, gw, gx, gy, gz, here)

    g0, g1, g2 = load3(grad_scales, i, here)
    s0, s1, s2 = load3(scales, i, here)
    g0, g1, g2 = g0 * s0 * tl.exp(t7), g1 * s1 * tl.exp(t8), g2 * s2 * tl.exp(t9)
    store3(out_log_scales, i, g0, g1, g2, here)
    l0, l1, l2 = load3(log_scales, i, here)
    by7, by8, by9 = g0 * l0, g1 * l1, g2 * l2
    opacity = tl.load(opacities + i, mask=here, other=0.0)
    by_opacity = tl.load(grad_opacities + i, mask=here, other=0.0)
    tl.store(out_logits + i, by_opacity * (1.0 - opacity) * opacity, mask=here)

    by0, by1, by2 = by0 * tanh_slope(t0), by1 * tanh_slope(t1), by2 * tanh_slope(t2)
    by3, by4, by5, by6 = by3 * tanh_slope(t3), by4 * tanh_slope(t4), by5 * tanh_slope(t5), by6 * tanh_slope(t6)
    by7, by8, by9 = by7 * tanh_slope(t7), by8 * tanh_slope(t8), by9 * tanh_slope(t9)
    if HAS_HYPER:
        all_lanes = i < (count + PACKED - 1) // PACKED * PACKED
        heads_backward(
            nodes, cells, weights, packed, raw, i, latents, by0, by1, by2, by3, by4, by5, by6, by7, by8, by9,
            out_values, out_packed, HAS_GRID, here, all_lanes,
        )  # fmt: skip
    else:
        store10(out_values, i, by0, by1, by2, by3, by4, by5, by6, by7, by8, by9, here)


@triton.jit(do_not_specialize=["parts", "width"])
def gather_nodes(begins, touching, weights, gradients, parts, width, out, LANES: tl.constexpr, WIDTH: tl.constexpr):
    """Sum what belongs to each node, in a fixed order: out[m] = sum of weight * gradients[i] over its list.

    begins int64 [M + 1]; touching int32 and weights float32 [number of list entries]; gradients [N, width]; out [M, width].
    `parts` programs for each node, for WIDTH of its values each; LANES entries at a time.
    """
    node, column = tl.program_id(0) // parts, tl.program_id(0) % parts * WIDTH + tl.arange(0, WIDTH)
    begin, end = tl.load(begins + node), tl.load(begins + node + 1)
    total = tl.zeros([LANES, WIDTH], tl.float32)
    for first in range(begin, end, LANES):
        at = first + tl.arange(0, LANES)
        i = tl.load(touching + at, mask=at < end, other=0)
        weight = tl.load(weights + at, mask=at < end, other=0.0)
        mask = (at < end)[:, None] & (column < width)[None, :]
        total += weight[:, None] * tl.load(gradients + i[:, None] * width + column[None, :], mask=mask, other=0.0)
    tl.store(out + node * width + column, tl.sum(total, 0), mask=column < width)
