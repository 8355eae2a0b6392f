"""Projection of the Gaussians and their colour, backward, from the moments that the tiles found."""

import triton
import triton.language as tl

from avatar.kernels.composite_backward import MOMENTS
from avatar.kernels.geometry import (
    BLUR,
    FX,
    FY,
    POSE_VALUES,
    SLOPE_X,
    SLOPE_Y,
    TRANSLATION,
    WHITENING,
    clamped_slope,
    covariance,
    dot3,
    image_rows,
    in_camera,
    load_scales,
    rotation_of,
    unit_quaternion,
    view_direction,
)
from avatar.kernels.load_store import load3, store3, store4
from avatar.kernels.sh import colour_backward

HALF_LOG2E = tl.constexpr(0.72134752044448170368)


@triton.jit(do_not_specialize=["count", "capacity"])
def sum_moments(
    order,
    ends,
    boxes,
    places,
    moments,
    count,
    capacity,
    sums,
    LANES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Sum each splat's moments over its slots, in a fixed order: sums [9, count], float64; LANES slots at a time.

    A kernel of its own, whose lanes share a splat's slots: a few splats have hundreds, and a lane for each would wait for
    the longest.
    """
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = rank < count
    i = tl.load(order + rank, mask=here, other=0).to(tl.int32)
    spoilt = tl.load(ends + count - 1) > capacity
    tiles = tl.where(spoilt, 0, tl.load(boxes + 3 * count + i, mask=here, other=0))
    begin = tl.where(spoilt, 0, tl.load(ends + rank, mask=here, other=0)).to(tl.int32) - tiles
    zero = tl.zeros([BLOCK, LANES], tl.float64)
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for first in range(0, tl.max(tiles, 0), LANES):
        j = first + tl.arange(0, LANES)[None, :]
        slot = begin[:, None] + j
        live = (j < tiles[:, None]) & (slot < capacity)
        place = tl.load(places + slot, mask=live, other=-1)
        live &= place >= 0
        at = moments + MOMENTS * place
        m0 += tl.load(at, mask=live, other=0.0).to(tl.float64)
        m1 += tl.load(at + 1, mask=live, other=0.0).to(tl.float64)
        m2 += tl.load(at + 2, mask=live, other=0.0).to(tl.float64)
        m3 += tl.load(at + 3, mask=live, other=0.0).to(tl.float64)
        m4 += tl.load(at + 4, mask=live, other=0.0).to(tl.float64)
        m5 += tl.load(at + 5, mask=live, other=0.0).to(tl.float64)
        m6 += tl.load(at + 6, mask=live, other=0.0).to(tl.float64)
        m7 += tl.load(at + 7, mask=live, other=0.0).to(tl.float64)
        m8 += tl.load(at + 8, mask=live, other=0.0).to(tl.float64)
    out = sums + i
    tl.store(out, tl.sum(m0, 1), mask=here)
    tl.store(out + count, tl.sum(m1, 1), mask=here)
    tl.store(out + 2 * count, tl.sum(m2, 1), mask=here)
    tl.store(out + 3 * count, tl.sum(m3, 1), mask=here)
    tl.store(out + 4 * count, tl.sum(m4, 1), mask=here)
    tl.store(out + 5 * count, tl.sum(m5, 1), mask=here)
    tl.store(out + 6 * count, tl.sum(m6, 1), mask=here)
    tl.store(out + 7 * count, tl.sum(m7, 1), mask=here)
    tl.store(out + 8 * count, tl.sum(m8, 1), mask=here)


@triton.jit
def _own(count, BLOCK: tl.constexpr):
    """The Gaussian of each lane, and whether there is one."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return i, i < count


@triton.jit
def _sum(sums, k: tl.constexpr, count, i, here):
    return tl.load(sums + k * count + i, mask=here, other=0.0)


# Two more, because Triton's compilers take time by the cube of a kernel's length: together they took five times as long.


@triton.jit(do_not_specialize=["degree", "count"])
def colour_of_backward(
    means,
    sh,
    pose,
    sums,
    degree,
    count,
    grad_means,
    grad_sh,
    STORED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the gradients of the coefficients, and that of the means by way of the direction they are seen from."""
    i, here = _own(count, BLOCK)
    m_red, m_green, m_blue = _sum(sums, 6, count, i, here), _sum(sums, 7, count, i, here), _sum(sums, 8, count, i, here)
    # Where all moments are zero, so must be all that follows: values that cannot overflow stand in there.
    shown = here & ((m_red != 0.0) | (m_green != 0.0) | (m_blue != 0.0))
    mean_x, mean_y, mean_z = load3(means, i, shown)
    d_x, d_y, d_z, inv_distance = view_direction(pose, mean_x, mean_y, mean_z)
    at = 3 * STORED * i
    by_dx, by_dy, by_dz = colour_backward(
        sh + at, grad_sh + at, d_x, d_y, d_z, m_red, m_green, m_blue, degree, STORED, shown, here
    )
    by_dx, by_dy, by_dz = by_dx.to(tl.float64), by_dy.to(tl.float64), by_dz.to(tl.float64)
    along = by_dx * d_x + by_dy * d_y + by_dz * d_z
    m_x, m_y = (by_dx - along * d_x) * inv_distance, (by_dy - along * d_y) * inv_distance
    m_z = (by_dz - along * d_z) * inv_distance
    store3(grad_means, i, m_x.to(tl.float32), m_y.to(tl.float32), m_z.to(tl.float32), here)


@triton.jit
def _row_of_pose(grad_pose, pose, row: tl.constexpr, by_p, mean_x, mean_y, mean_z, by_x, by_y, by_z, e0, e1, e2):
    """Sum what one row of R and one element of t take: by p = R m + t, by T (as e), and by the direction along m + R^T t
    that the colour depends on, of which (by_x, by_y, by_z) is the gradient in m."""
    t = tl.load(pose + TRANSLATION + row)
    tl.store(grad_pose + 3 * row, tl.sum(by_p * mean_x + t * by_x + e0, 0))
    tl.store(grad_pose + 3 * row + 1, tl.sum(by_p * mean_y + t * by_y + e1, 0))
    tl.store(grad_pose + 3 * row + 2, tl.sum(by_p * mean_z + t * by_z + e2, 0))
    v0, v1, v2 = tl.load(pose + 3 * row), tl.load(pose + 3 * row + 1), tl.load(pose + 3 * row + 2)
    tl.store(grad_pose + TRANSLATION + row, tl.sum(by_p + dot3(v0, v1, v2, by_x, by_y, by_z), 0))


@triton.jit(do_not_specialize=["count"])
def project_backward(
    means,
    quats,
    scales,
    opacities,
    pose,
    intrinsics,
    sums,
    count,
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    grad_pose,
    ANTIALIASED: tl.constexpr,
    POSE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the other gradients of all Gaussians; one lane for each. `grad_means` is added to what `colour_of_backward`
    wrote there; see `project` for the other buffers. With POSE, grad_pose [programs, 12], float64, takes what the Gaussians
    of each program add to the gradient of the pose."""
    i, here = _own(count, BLOCK)
    weight, m_u, m_uu = _sum(sums, 0, count, i, here), _sum(sums, 1, count, i, here), _sum(sums, 2, count, i, here)
    m_v, m_uv, m_vv = _sum(sums, 3, count, i, here), _sum(sums, 4, count, i, here), _sum(sums, 5, count, i, here)
    shown = (weight != 0.0) | (m_u != 0.0) | (m_uu != 0.0) | (m_v != 0.0) | (m_uv != 0.0) | (m_vv != 0.0)
    shown = here & shown

    mean_x, mean_y, mean_z = load3(means, i, shown)
    p_x, p_y, p_z = in_camera(pose, mean_x, mean_y, mean_z)
    p_z = tl.where(shown, p_z, 1.0)
    inv_z = 1.0 / p_z
    slope_x, free_x = clamped_slope(intrinsics, SLOPE_X, p_x * inv_z)
    slope_y, free_y = clamped_slope(intrinsics, SLOPE_Y, p_y * inv_z)
    t00, t01, t02, t10, t11, t12 = image_rows(pose, intrinsics, slope_x, slope_y, inv_z)
    qw, qx, qy, qz, inv_length = unit_quaternion(quats, i, shown)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(qw, qx, qy, qz)
    s0, s1, s2 = load_scales(scales, i, shown)
    f00, f01, f02 = (
        dot3(t00, t01, t02, r00, r10, r20) * s0,
        dot3(t00, t01, t02, r01, r11, r21) * s1,
        dot3(t00, t01, t02, r02, r12, r22) * s2,
    )
    f10, f11, f12 = (
        dot3(t10, t11, t12, r00, r10, r20) * s0,
        dot3(t10, t11, t12, r01, r11, r21) * s1,
        dot3(t10, t11, t12, r02, r12, r22) * s2,
    )
    n0, n1, n2, area, _, xy, yy, det = covariance(intrinsics, f00, f01, f02, f10, f11, f12)
    det, yy = tl.where(shown, det, 1.0), tl.where(shown, yy, 1.0)
    root_det, root = tl.sqrt(det), tl.sqrt(yy)
    a, b, c = root * WHITENING / root_det, -xy * WHITENING / (root * root_det), WHITENING / root

    # alpha = opacity * shrink * 2^-(u^2 + v^2); `shrink` is 1 unless antialiased.
    opacity = tl.load(opacities + i, mask=shown, other=0.0).to(tl.float64)
    shrink = tl.full([BLOCK], 1.0, tl.float64)
    if ANTIALIASED:
        shrink = area / root_det
    tl.store(grad_opacities + i, (weight * shrink).to(tl.float32), mask=here)

    # d log(alpha) / d(x, y) = 2 ln 2 (a, 0; b, c) (u, v), and 2 ln 2 = 1 / HALF_LOG2E.
    strength = opacity * shrink
    grad_x = strength / HALF_LOG2E * a * m_u
    grad_y = strength / HALF_LOG2E * (b * m_u + c * m_v)
    # d log(alpha) / d covariance = 1/2 (L^T y)(L^T y)^T with y = (u, v) / WHITENING and L = (a, b; 0, c) / WHITENING.
    half = 0.5 * strength / (HALF_LOG2E * HALF_LOG2E)
    by_xx = half * a * a * m_uu
    by_xy = half * a * (b * m_uu + c * m_uv)
    by_yy = half * (b * (b * m_uu + c * m_uv) + c * (b * m_uv + c * m_vv))
    g00, g01, g02 = (
        2 * (by_xx * f00 + by_xy * f10),
        2 * (by_xx * f01 + by_xy * f11),
        2 * (by_xx * f02 + by_xy * f12),
    )
    g10, g11, g12 = (
        2 * (by_xy * f00 + by_yy * f10),
        2 * (by_xy * f01 + by_yy * f11),
        2 * (by_xy * f02 + by_yy * f12),
    )
    if ANTIALIASED:
        # shrink = area / sqrt(det), area = |f0 x f1|, det = area^2 + blur (|f0|^2 + |f1|^2) + blur^2
        by_shrink = weight * opacity
        by_area = by_shrink / root_det * (1.0 - area * area / det)
        per_row = -by_shrink * shrink / det * tl.load(intrinsics + BLUR)
        scale = by_area * tl.where(area > 0.0, 1.0 / tl.where(area > 0.0, area, 1.0), 0.0)
        g00 += scale * (f11 * n2 - f12 * n1) + per_row * f00
        g01 += scale * (f12 * n0 - f10 * n2) + per_row * f01
        g02 += scale * (f10 * n1 - f11 * n0) + per_row * f02
        g10 += scale * (n1 * f02 - n2 * f01) + per_row * f10
        g11 += scale * (n2 * f00 - n0 * f02) + per_row * f11
        g12 += scale * (n0 * f01 - n1 * f00) + per_row * f12

    # F = T R diag(scales): its scales, the rotation R (as h) and T (as e).
    h00, h10, h20 = t00 * g00 + t10 * g10, t01 * g00 + t11 * g10, t02 * g00 + t12 * g10
    h01, h11, h21 = t00 * g01 + t10 * g11, t01 * g01 + t11 * g11, t02 * g01 + t12 * g11
    h02, h12, h22 = t00 * g02 + t10 * g12, t01 * g02 + t11 * g12, t02 * g02 + t12 * g12
    by_s0, by_s1 = dot3(h00, h10, h20, r00, r10, r20), dot3(h01, h11, h21, r01, r11, r21)
    by_s2 = dot3(h02, h12, h22, r02, r12, r22)
    store3(grad_scales, i, by_s0.to(tl.float32), by_s1.to(tl.float32), by_s2.to(tl.float32), here)
    h00, h10, h20 = h00 * s0, h10 * s0, h20 * s0
    h01, h11, h21 = h01 * s1, h11 * s1, h21 * s1
    h02, h12, h22 = h02 * s2, h12 * s2, h22 * s2
    g00, g01, g02, g10, g11, g12 = g00 * s0, g01 * s1, g02 * s2, g10 * s0, g11 * s1, g12 * s2
    e00, e01, e02 = (
        dot3(g00, g01, g02, r00, r01, r02),
        dot3(g00, g01, g02, r10, r11, r12),
        dot3(g00, g01, g02, r20, r21, r22),
    )
    e10, e11, e12 = (
        dot3(g10, g11, g12, r00, r01, r02),
        dot3(g10, g11, g12, r10, r11, r12),
        dot3(g10, g11, g12, r20, r21, r22),
    )

    by_w = 2 * (qx * (h21 - h12) + qy * (h02 - h20) + qz * (h10 - h01))
    by_x = 2 * (qw * (h21 - h12) - 2 * qx * (h11 + h22) + qy * (h01 + h10) + qz * (h02 + h20))
    by_y = 2 * (qw * (h02 - h20) + qx * (h01 + h10) - 2 * qy * (h00 + h22) + qz * (h12 + h21))
    by_z = 2 * (qw * (h10 - h01) + qx * (h02 + h20) + qy * (h12 + h21) - 2 * qz * (h00 + h11))
    radial = by_w * qw + by_x * qx + by_y * qy + by_z * qz
    by_w, by_x = ((by_w - radial * qw) * inv_length).to(tl.float32), ((by_x - radial * qx) * inv_length).to(tl.float32)
    by_y, by_z = ((by_y - radial * qy) * inv_length).to(tl.float32), ((by_z - radial * qz) * inv_length).to(tl.float32)
    store4(grad_quats, i, by_w, by_x, by_y, by_z, here)

    # A row of T is f / z (R_row - slope R_z), and the slope p / z where it is not clamped.
    fx, fy = tl.load(intrinsics + FX), tl.load(intrinsics + FY)
    by_px, by_py = grad_x * fx * inv_z, grad_y * fy * inv_z
    by_pz = -(grad_x * fx * p_x + grad_y * fy * p_y) * inv_z * inv_z
    v0, v1, v2 = tl.load(pose), tl.load(pose + 1), tl.load(pose + 2)
    v3, v4, v5 = tl.load(pose + 3), tl.load(pose + 4), tl.load(pose + 5)
    v6, v7, v8 = tl.load(pose + 6), tl.load(pose + 7), tl.load(pose + 8)
    along_z = dot3(e00, e01, e02, v6, v7, v8)
    by_pz -= fx * inv_z * inv_z * (dot3(e00, e01, e02, v0, v1, v2) - slope_x * along_z)
    by_slope = tl.where(free_x, -fx * inv_z * along_z, 0.0)
    by_px += by_slope * inv_z
    by_pz -= by_slope * slope_x * inv_z
    along_z = dot3(e10, e11, e12, v6, v7, v8)
    by_pz -= fy * inv_z * inv_z * (dot3(e10, e11, e12, v3, v4, v5) - slope_y * along_z)
    by_slope = tl.where(free_y, -fy * inv_z * along_z, 0.0)
    by_py += by_slope * inv_z
    by_pz -= by_slope * slope_y * inv_z

    by_x, by_y, by_z = load3(grad_means, i, here)
    m_x = dot3(v0, v3, v6, by_px, by_py, by_pz) + by_x
    m_y = dot3(v1, v4, v7, by_px, by_py, by_pz) + by_y
    m_z = dot3(v2, v5, v8, by_px, by_py, by_pz) + by_z
    store3(grad_means, i, m_x.to(tl.float32), m_y.to(tl.float32), m_z.to(tl.float32), here)
    if POSE:
        own = grad_pose + POSE_VALUES * tl.program_id(0)
        e00, e01, e02 = e00 * (fx * inv_z), e01 * (fx * inv_z), e02 * (fx * inv_z)
        e10, e11, e12 = e10 * (fy * inv_z), e11 * (fy * inv_z), e12 * (fy * inv_z)
        e20, e21, e22 = -slope_x * e00 - slope_y * e10, -slope_x * e01 - slope_y * e11, -slope_x * e02 - slope_y * e12
        _row_of_pose(own, pose, 0, by_px, mean_x, mean_y, mean_z, by_x, by_y, by_z, e00, e01, e02)
        _row_of_pose(own, pose, 1, by_py, mean_x, mean_y, mean_z, by_x, by_y, by_z, e10, e11, e12)
        _row_of_pose(own, pose, 2, by_pz, mean_x, mean_y, mean_z, by_x, by_y, by_z, e20, e21, e22)
