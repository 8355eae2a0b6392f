"""Compositing of the tiles, forward: one program for each tile, front to back, CHUNK splats at a time."""

import triton
import triton.language as tl

from avatar.kernels.bin import first_record

NEVER_STOPS = tl.constexpr(0x7FFFFFFF)


@triton.jit
def tile_pixels(tile, width, first_x, first_y, across, left, top, right, bottom, TILE: tl.constexpr):
    """Column and row of each pixel in the tile, its place in the image, and whether it is to be drawn."""
    i = tl.arange(0, TILE * TILE)
    column, row = i % TILE, i // TILE
    x, y = (first_x + tile % across) * TILE + column, (first_y + tile // across) * TILE + row
    inside = (x >= left) & (x < right) & (y >= top) & (y < bottom)
    return column.to(tl.float32), row.to(tl.float32), y * width + x, inside


@triton.jit
def falloffs(records, stride, at, column, row):
    """(u, v) of CHUNK splats at each pixel, 2^-(u^2 + v^2), and alpha before it is clamped; [CHUNK, pixels].

    Both directions come here: they must decide alike, to the last bit, what is drawn.
    """
    a, b, c = tl.load(records + 2 * stride + at), tl.load(records + 3 * stride + at), tl.load(records + 4 * stride + at)
    u = tl.load(records + at)[:, None] + b[:, None] * row[None, :]
    u = tl.fma(a[:, None], column[None, :], u)
    v = tl.fma(c[:, None], row[None, :], tl.load(records + stride + at)[:, None])
    falloff = tl.exp2(-tl.fma(u, u, v * v))
    return u, v, falloff, tl.load(records + 5 * stride + at)[:, None] * falloff


@triton.jit
def weights(records, stride, at, done, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max, t_min):
    """Of a step's splats, pairs `done + k`: weight, the transmittance behind each, and whether enough is left of it for
    the splat to be drawn; [STEP, pixels].
    """
    _, _, _, unclamped = falloffs(records, stride, at, column, row)
    alpha = tl.minimum(unclamped, alpha_max)
    hit = (alpha >= alpha_min) & (done + k < pairs)[:, None]
    alpha = tl.where(hit, alpha, 0.0)
    # The transmittance only falls: the first splat that brings it below t_min and all after it are not drawn.
    after = transmittance[None, :] * tl.cumprod(1.0 - alpha, 0)
    enough = (after >= t_min) & (done < stop)[None, :]
    drawn = hit & enough
    return tl.where(drawn, after * (alpha / (1.0 - alpha)), 0.0), after, enough


@triton.jit
def behind_step(after, enough, done, transmittance, stop, STEP: tl.constexpr):
    """Each pixel's transmittance and stop behind a step's splats."""
    transmittance = tl.min(tl.where(enough, after, transmittance[None, :]), 0)
    reached = done + tl.sum(enough.to(tl.int32), 0)
    return transmittance, tl.where((reached < done + STEP) & (done < stop), reached, stop)


@triton.jit(
    do_not_specialize=["count", "capacity", "width", "first_x", "first_y", "across", "left", "top", "right", "bottom"]
)
def composite(
    records,
    begins,
    ends,
    background,
    alpha_min,
    alpha_max,
    t_min,
    count,
    capacity,
    stride,
    width,
    first_x,
    first_y,
    across,
    left,
    top,
    right,
    bottom,
    image,
    alphas,
    transmittances,
    stops,
    chunks,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
    STEP: tl.constexpr,
):
    """Draw the pixels of the region [left, right) x [top, bottom); see `bin` for records, begins and ends.

    image float32 [H, W, 3], alphas and transmittances [H, W], stops int32 [H, W]: the pair of the tile's list from which on
    the pixel shows none;  chunks int32 [tiles]: of STEP pairs, that were looked at. Everything drawn is NaN where the pairs
    exceed the capacity.
    """
    tile = tl.program_id(0)
    column, row, pixel, inside = tile_pixels(tile, width, first_x, first_y, across, left, top, right, bottom, TILE)
    begin = tl.load(begins + tile)
    pairs = tl.load(begins + tile + 1) - begin
    first = tl.multiple_of(first_record(begin, tile, CHUNK), CHUNK)
    k = tl.arange(0, STEP)
    transmittance = tl.where(inside, 1.0, 0.0)
    red, green, blue = tl.zeros_like(transmittance), tl.zeros_like(transmittance), tl.zeros_like(transmittance)
    stop = tl.where(inside, NEVER_STOPS, 0)
    done = 0
    alive = 1
    while (done < pairs) & (alive > 0):
        at = first + done + k
        weight, after, enough = weights(
            records, stride, at, done, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max, t_min
        )
        red += tl.sum(weight * tl.load(records + 6 * stride + at)[:, None], 0)
        green += tl.sum(weight * tl.load(records + 7 * stride + at)[:, None], 0)
        blue += tl.sum(weight * tl.load(records + 8 * stride + at)[:, None], 0)
        transmittance, stop = behind_step(after, enough, done, transmittance, stop, STEP)
        alive = tl.max((stop == NEVER_STOPS).to(tl.int32), 0)
        done += STEP
    tl.store(chunks + tile, done // STEP)

    spoilt = tl.load(ends + count - 1) > capacity
    rest = tl.where(spoilt, float("nan"), transmittance)
    tl.store(image + 3 * pixel, red + rest * tl.load(background), mask=inside)
    tl.store(image + 3 * pixel + 1, green + rest * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * pixel + 2, blue + rest * tl.load(background + 2), mask=inside)
    tl.store(alphas + pixel, 1.0 - rest, mask=inside)
    tl.store(transmittances + pixel, transmittance, mask=inside)
    tl.store(stops + pixel, stop, mask=inside)
