"""Compositing of the tiles, backward: one program for each tile, back to front."""

import triton
import triton.language as tl

from avatar.kernels.bin import first_record
from avatar.kernels.composite import falloffs, tile_pixels

# What is found for one splat in one tile, and the sum of that over tiles. The first is dL/dalpha * alpha / opacity, summed
# over pixels, the next five are its moments (u, uu, v, uv, vv), the last dL/d(red, green, blue).
MOMENTS = tl.constexpr(9)


@triton.jit
def recompute_splats(records, stride, at, start, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max):
    """STEP splats once more, from behind: (u, v), falloff, alpha before it is clamped, whether drawn, 1 - alpha, the
    transmittance behind each, its weight [STEP, pixels], and the transmittance in front of all."""
    u, v, falloff, unclamped = falloffs(records, stride, at, column, row)
    clamped = tl.minimum(unclamped, alpha_max)
    live = (start + k < pairs)[:, None] & ((start + k)[:, None] < stop[None, :])
    drawn = (clamped >= alpha_min) & live
    alpha = tl.where(drawn, clamped, 0.0)
    through = 1.0 - alpha

    # The transmittances behind each splat, from the one behind all of them.
    passed = tl.cumprod(through, 0)
    transmittance = transmittance / tl.min(passed, 0)
    after = transmittance[None, :] * passed
    shown = (after / through) * alpha
    return u, v, falloff, unclamped, drawn, through, after, shown, transmittance


@triton.jit
def store_shape(to, u, v, weight):
    """The first six moments."""
    weight_u, weight_v = weight * u, weight * v
    tl.store(to, tl.sum(weight, 1))
    tl.store(to + 1, tl.sum(weight_u, 1))
    tl.store(to + 2, tl.sum(weight_u * u, 1))
    tl.store(to + 3, tl.sum(weight_v, 1))
    tl.store(to + 4, tl.sum(weight_u * v, 1))
    tl.store(to + 5, tl.sum(weight_v * v, 1))


# With g = dL/dcolour of a pixel, T_k the transmittance in front of splat k and A = 1 - T_end the alpha output, splat k's
# alpha has the gradient
#     T_k g.c_k - behind_k / (1 - alpha_k) = (T_{k+1} g.c_k - behind_k) / (1 - alpha_k),
#     behind_k = sum over j > k of T_j alpha_j g.c_j + T_end (g.background - dL/dA).
# `behind` is a sum of what lies behind only: taking a splat's own part off a sum again would cancel where alpha is near 1.
@triton.jit(do_not_specialize=["width", "first_x", "first_y", "across", "left", "top", "right", "bottom"])
def composite_backward(
    records,
    begins,
    chunks,
    background,
    transmittances,
    stops,
    grad_image,
    grad_alpha,
    alpha_min,
    alpha_max,
    stride,
    width,
    first_x,
    first_y,
    across,
    left,
    top,
    right,
    bottom,
    moments,
    HAS_IMAGE: tl.constexpr,
    HAS_ALPHA: tl.constexpr,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
    STEP: tl.constexpr,
    FORWARD_STEP: tl.constexpr,
):
    """Write the moments [stride, 9] of every pair's record; grad_image [H, W, 3], grad_alpha [H, W]."""
    tile = tl.program_id(0)
    column, row, pixel, inside = tile_pixels(tile, width, first_x, first_y, across, left, top, right, bottom, TILE)
    begin = tl.load(begins + tile)
    pairs = tl.load(begins + tile + 1) - begin
    first = tl.multiple_of(first_record(begin, tile, CHUNK), CHUNK)
    k = tl.arange(0, STEP)
    later = k[None, :] > k[:, None]

    transmittance = tl.load(transmittances + pixel, mask=inside, other=1.0)
    stop = tl.load(stops + pixel, mask=inside, other=0)
    g_red, g_green, g_blue = tl.zeros_like(column), tl.zeros_like(column), tl.zeros_like(column)
    behind = tl.zeros_like(column)
    if HAS_IMAGE:
        g_red = tl.load(grad_image + 3 * pixel, mask=inside, other=0.0)
        g_green = tl.load(grad_image + 3 * pixel + 1, mask=inside, other=0.0)
        g_blue = tl.load(grad_image + 3 * pixel + 2, mask=inside, other=0.0)
        behind = g_red * tl.load(background) + g_green * tl.load(background + 1) + g_blue * tl.load(background + 2)
    if HAS_ALPHA:
        behind -= tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    behind = transmittance * behind

    # What was looked at, in steps of this direction; what of it no pixel shows is behind all of their stops.
    seen = (tl.minimum(tl.load(chunks + tile) * FORWARD_STEP, pairs) + STEP - 1) // STEP * STEP
    for start in range(seen, pairs, STEP):  # behind what every pixel shows
        for moment in tl.static_range(MOMENTS):
            tl.store(
                moments + MOMENTS * (first + start + k) + moment, tl.zeros([STEP], tl.float32), mask=start + k < pairs
            )
    for done in range(0, seen, STEP):
        start = seen - STEP - done
        at = first + start + k
        u, v, falloff, unclamped, drawn, through, after, shown, transmittance = recompute_splats(
            records, stride, at, start, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max
        )
        g = tl.fma(
            g_red[None, :],
            tl.load(records + 6 * stride + at)[:, None],
            g_green[None, :] * tl.load(records + 7 * stride + at)[:, None],
        )
        g = tl.fma(g_blue[None, :], tl.load(records + 8 * stride + at)[:, None], g)
        adds = shown * g
        hidden = behind[None, :] + tl.sum(tl.where(later[:, :, None], adds[None, :, :], 0.0), 1)
        behind += tl.sum(adds, 0)
        weight = tl.where(drawn & (unclamped <= alpha_max), tl.fma(after, g, -hidden) / through * falloff, 0.0)

        to = moments + MOMENTS * at
        store_shape(to, u, v, weight)
        tl.store(to + 6, tl.sum(shown * g_red[None, :], 1))
        tl.store(to + 7, tl.sum(shown * g_green[None, :], 1))
        tl.store(to + 8, tl.sum(shown * g_blue[None, :], 1))
