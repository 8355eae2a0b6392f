"""Projection of the Gaussians and their colour, forward: one launch, one lane for each Gaussian."""

import triton
import triton.language as tl

from avatar.kernels.geometry import (
    CX,
    CY,
    FX,
    FY,
    NEAR,
    SLOPE_X,
    SLOPE_Y,
    WHITENING,
    clamped_slope,
    covariance,
    dot3,
    image_rows,
    in_camera,
    load_scales,
    not_finite,
    pose_is_not_finite,
    rotation_of,
    unit_quaternion,
    view_direction,
)
from avatar.kernels.load_store import load3
from avatar.kernels.sh import colour

REACH_MARGIN = tl.constexpr(1e-4)  # in log2 of alpha; far above float rounding there
# A count that no capacity holds: a value that is not finite makes the image NaN as too many pairs do.
POISON = tl.constexpr(1 << 30)
SIDE, FARTHEST = tl.constexpr(1 << 15), tl.constexpr(1e37)  # pixels of an image; (u, v) below which float32 holds them


@triton.jit
def _tiles_between(low, high, pixels, first_tile, tiles, TILE: tl.constexpr):
    """The first tile, counted from the grid's, and the number of tiles with a pixel centre of [low, high] in the image.

    Whole tiles of the grid, whatever part of them is drawn: a tile's list of splats is the same in every region.
    """
    first = tl.maximum(tl.minimum(tl.ceil(low - 0.5), pixels * 1.0), 0.0).to(tl.int32)
    last = tl.maximum(tl.minimum(tl.floor(high - 0.5), pixels - 1.0), -1.0).to(tl.int32)
    begin = tl.maximum(first // TILE, first_tile)
    end = tl.minimum((last + TILE) // TILE, first_tile + tiles)  # (-1 + TILE) // TILE is 0
    return begin - first_tile, tl.where(first <= last, tl.maximum(end - begin, 0), 0)


@triton.jit(
    do_not_specialize=["degree", "channels", "count", "width", "height", "first_x", "first_y", "across", "down"]
)
def project(
    means,
    quats,
    scales,
    opacities,
    sh,
    pose,
    intrinsics,
    alpha_min,
    degree,
    channels,
    count,
    width,
    height,
    first_x,
    first_y,
    across,
    down,
    depths,
    ellipses,
    looks,
    boxes,
    STORED: tl.constexpr,
    ANTIALIASED: tl.constexpr,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write, for every Gaussian:

    depths     float64 [N], of the centre; infinite where nothing is drawn
    ellipses   float64 [5, N]: x, y (pixels) and a, b, c. With d = pixel - (x, y), u = a d_x + b d_y and v = c d_y, alpha
               is opacity * 2^-(u^2 + v^2)
    looks      float32 [5, N]: opacity, reach (alpha can reach alpha_min where u^2 + v^2 <= reach only), red, green, blue;
               [2, N], without a colour, where `sh` is features [N, channels] and STORED is 0
    boxes      int32 [4, N]: first tile across and down, tiles across, tiles in all
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    mean_x, mean_y, mean_z = load3(means, i, here)
    opacity = tl.load(opacities + i, mask=here, other=0.0)
    poisoned = pose_is_not_finite(pose)
    poisoned |= not_finite(mean_x) | not_finite(mean_y) | not_finite(mean_z) | not_finite(opacity)
    for k in tl.static_range(4):
        poisoned |= not_finite(tl.load(quats + 4 * i + k, mask=here, other=0.0))
    for k in tl.static_range(3):
        poisoned |= not_finite(tl.load(scales + 3 * i + k, mask=here, other=0.0))
    for k in tl.static_range(3 * STORED):
        poisoned |= not_finite(tl.load(sh + 3 * STORED * i + k, mask=here, other=0.0))

    if STORED == 0:
        for k in range(channels):
            poisoned |= not_finite(tl.load(sh + i.to(tl.int64) * channels + k, mask=here, other=0.0))

    transparent = opacity < alpha_min
    p_x, p_y, p_z = in_camera(pose, mean_x, mean_y, mean_z)
    in_front = p_z >= tl.load(intrinsics + NEAR)
    p_z = tl.where(in_front, p_z, 1.0)
    inv_z = 1.0 / p_z
    slope_x, _ = clamped_slope(intrinsics, SLOPE_X, p_x * inv_z)
    slope_y, _ = clamped_slope(intrinsics, SLOPE_Y, p_y * inv_z)
    t00, t01, t02, t10, t11, t12 = image_rows(pose, intrinsics, slope_x, slope_y, inv_z)
    qw, qx, qy, qz, _ = unit_quaternion(quats, i, here)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(qw, qx, qy, qz)
    s0, s1, s2 = load_scales(scales, i, here)
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
    _, _, _, area, xx, xy, yy, det = covariance(intrinsics, f00, f01, f02, f10, f11, f12)
    solid = (det > 0.0) & (det < float("inf"))  # neither for a NaN
    det, yy = tl.where(solid, det, 1.0), tl.where(solid, yy, 1.0)
    root_det = tl.sqrt(det)
    if ANTIALIASED:
        opacity = (opacity * area / root_det).to(tl.float32)
        transparent |= solid & in_front & (opacity < alpha_min)
    drawn = here & ~transparent & in_front & solid

    x = tl.load(intrinsics + FX) * p_x / p_z + tl.load(intrinsics + CX)
    y = tl.load(intrinsics + FY) * p_y / p_z + tl.load(intrinsics + CY)
    root = tl.sqrt(yy)
    a = root * WHITENING / root_det
    b = -xy * WHITENING / (root * root_det)
    c = WHITENING / root
    # What is farther from its own middle than float32 can say shows nowhere: a splat of 1e-30 pixels, without blur.
    far_y = tl.abs(y) + SIDE
    drawn &= (a * (tl.abs(x) + SIDE) + tl.abs(b) * far_y < FARTHEST) & (c * far_y < FARTHEST)
    ratio = tl.where(drawn, opacity, 1.0) / alpha_min  # infinite for an alpha_min of 0
    reach = tl.where(alpha_min > 0.0, tl.log2(ratio) + REACH_MARGIN, tl.full([BLOCK], float("inf"), tl.float32))
    bounded = reach < float("inf")
    size = tl.sqrt(tl.where(bounded, reach, 0.0).to(tl.float64)) / WHITENING
    half_x, half_y = size * tl.sqrt(tl.where(drawn, xx, 0.0)), size * tl.sqrt(tl.where(drawn, yy, 0.0))
    half_x, half_y = tl.where(bounded, half_x, 1e300), tl.where(bounded, half_y, 1e300)
    tile_x, tiles_x = _tiles_between(x - half_x, x + half_x, width, first_x, across, TILE)
    tile_y, tiles_y = _tiles_between(y - half_y, y + half_y, height, first_y, down, TILE)
    tiles = tl.where(drawn, tiles_x * tiles_y, 0)

    if STORED > 0:
        d_x, d_y, d_z, _ = view_direction(pose, mean_x, mean_y, mean_z)
        red, green, blue = colour(sh + 3 * STORED * i, d_x, d_y, d_z, degree, STORED, here)
        poisoned |= (tiles > 0) & (not_finite(red) | not_finite(green) | not_finite(blue))

    tl.store(depths + i, tl.where(tiles > 0, p_z, float("inf")), mask=here)
    tl.store(ellipses + i, x, mask=here)
    tl.store(ellipses + count + i, y, mask=here)
    tl.store(ellipses + 2 * count + i, a, mask=here)
    tl.store(ellipses + 3 * count + i, b, mask=here)
    tl.store(ellipses + 4 * count + i, c, mask=here)
    tl.store(looks + i, opacity, mask=here)
    tl.store(looks + count + i, reach, mask=here)
    if STORED > 0:
        tl.store(looks + 2 * count + i, tl.maximum(red, 0.0), mask=here)
        tl.store(looks + 3 * count + i, tl.maximum(green, 0.0), mask=here)
        tl.store(looks + 4 * count + i, tl.maximum(blue, 0.0), mask=here)
    tl.store(boxes + i, tile_x, mask=here)
    tl.store(boxes + count + i, tile_y, mask=here)
    tl.store(boxes + 2 * count + i, tiles_x, mask=here)
    tl.store(boxes + 3 * count + i, tl.where(poisoned, POISON, tiles), mask=here)
