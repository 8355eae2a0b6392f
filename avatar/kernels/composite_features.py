"""Compositing of features: the tiles of `composite` and `composite_backward` with any number of channels, GROUP at a time.

The channels are products of matrices: of the splats' weights at the pixels and their features.
"""

import triton
import triton.language as tl

from avatar.kernels.bin import first_record
from avatar.kernels.composite import NEVER_STOPS, behind_step, tile_pixels, weights
from avatar.kernels.composite_backward import MOMENTS, recompute_splats, store_shape

SHAPE = tl.constexpr(6)  # moments that are not of a colour


@triton.jit
def _features(features, records, stride, at, channel, channels):
    """[splats, channels] of the records `at`; 0 beyond the last channel."""
    splat = tl.load(records + 6 * stride + at).to(tl.int32, bitcast=True).to(tl.int64)
    values = features + splat[:, None] * channels + channel[None, :]
    return tl.load(values, mask=(channel < channels)[None, :], other=0.0)


@triton.jit
def _at_pixels(image, pixel, channel, inside, channels):
    """Where the channels of pixels are in an image, and which of them there are; [channels, pixels]."""
    mask = (channel < channels)[:, None] & inside[None, :]
    return image + pixel.to(tl.int64)[None, :] * channels + channel[:, None], mask


@triton.jit(
    do_not_specialize=["count", "capacity", "width", "first_x", "first_y", "across", "left", "top", "right", "bottom"]
)
def composite_features(
    records,
    begins,
    ends,
    features,
    channels,
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
    GROUP: tl.constexpr,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
    STEP: tl.constexpr,
):
    """As `composite`, with features [N, channels], background [channels] and image [H, W, channels]; a program for every
    tile and GROUP channels. All programs of a tile write the same alphas, transmittances, stops and chunks."""
    groups = tl.cdiv(channels, GROUP)
    tile = tl.program_id(0) // groups
    channel = tl.program_id(0) % groups * GROUP + tl.arange(0, GROUP)
    column, row, pixel, inside = tile_pixels(tile, width, first_x, first_y, across, left, top, right, bottom, TILE)
    begin = tl.load(begins + tile)
    pairs = tl.load(begins + tile + 1) - begin
    first = tl.multiple_of(first_record(begin, tile, CHUNK), CHUNK)
    k = tl.arange(0, STEP)
    transmittance = tl.where(inside, 1.0, 0.0)
    shown = tl.zeros([GROUP, TILE * TILE], tl.float32)
    stop = tl.where(inside, NEVER_STOPS, 0)
    done = 0
    alive = 1
    while (done < pairs) & (alive > 0):
        at = first + done + k
        weight, after, enough = weights(
            records, stride, at, done, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max, t_min
        )
        own = tl.trans(_features(features, records, stride, at, channel, channels))
        shown = tl.dot(own, weight, shown, input_precision="ieee")
        transmittance, stop = behind_step(after, enough, done, transmittance, stop, STEP)
        alive = tl.max((stop == NEVER_STOPS).to(tl.int32), 0)
        done += STEP
    tl.store(chunks + tile, done // STEP)

    spoilt = tl.load(ends + count - 1) > capacity
    rest = tl.where(spoilt, float("nan"), transmittance)
    behind = tl.load(background + channel, mask=channel < channels, other=0.0)
    to, mask = _at_pixels(image, pixel, channel, inside, channels)
    tl.store(to, shown + rest[None, :] * behind[:, None], mask=mask)
    tl.store(alphas + pixel, 1.0 - rest, mask=inside)
    tl.store(transmittances + pixel, transmittance, mask=inside)
    tl.store(stops + pixel, stop, mask=inside)


@triton.jit(do_not_specialize=["width", "first_x", "first_y", "across", "left", "top", "right", "bottom"])
def composite_features_backward(
    records,
    begins,
    chunks,
    features,
    channels,
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
    by_features,
    HAS_IMAGE: tl.constexpr,
    HAS_ALPHA: tl.constexpr,
    GROUP: tl.constexpr,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
    STEP: tl.constexpr,
    FORWARD_STEP: tl.constexpr,
):
    """As `composite_backward`, but of every record's moments only the first SHAPE are written; dL/dfeature goes to
    by_features [stride, channels]."""
    tile = tl.program_id(0)
    column, row, pixel, inside = tile_pixels(tile, width, first_x, first_y, across, left, top, right, bottom, TILE)
    begin = tl.load(begins + tile)
    pairs = tl.load(begins + tile + 1) - begin
    first = tl.multiple_of(first_record(begin, tile, CHUNK), CHUNK)
    k, c = tl.arange(0, STEP), tl.arange(0, GROUP)
    later = k[None, :] > k[:, None]

    transmittance = tl.load(transmittances + pixel, mask=inside, other=1.0)
    stop = tl.load(stops + pixel, mask=inside, other=0)
    behind = tl.zeros_like(column)
    if HAS_IMAGE:
        for group in range(0, channels, GROUP):
            at_pixels, mask = _at_pixels(grad_image, pixel, group + c, inside, channels)
            ground = tl.load(background + group + c, mask=group + c < channels, other=0.0)
            behind += tl.sum(tl.load(at_pixels, mask=mask, other=0.0) * ground[:, None], 0)
    if HAS_ALPHA:
        behind -= tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    behind = transmittance * behind

    seen = (tl.minimum(tl.load(chunks + tile) * FORWARD_STEP, pairs) + STEP - 1) // STEP * STEP
    for start in range(seen, pairs, STEP):  # behind what every pixel shows
        at, here = first + start + k, start + k < pairs
        for moment in tl.static_range(SHAPE):
            tl.store(moments + MOMENTS * at + moment, tl.zeros([STEP], tl.float32), mask=here)
        for group in range(0, channels, GROUP):
            to = by_features + at.to(tl.int64)[:, None] * channels + (group + c)[None, :]
            mask = here[:, None] & (group + c < channels)[None, :]
            tl.store(to, tl.zeros([STEP, GROUP], tl.float32), mask=mask)
    for done in range(0, seen, STEP):
        start = seen - STEP - done
        at = first + start + k
        u, v, falloff, unclamped, drawn, through, after, shown, transmittance = recompute_splats(
            records, stride, at, start, k, pairs, column, row, transmittance, stop, alpha_min, alpha_max
        )
        g = tl.zeros([STEP, TILE * TILE], tl.float32)
        for group in range(0, channels, GROUP):
            to = by_features + at.to(tl.int64)[:, None] * channels + (group + c)[None, :]
            by_own = tl.zeros([STEP, GROUP], tl.float32)
            if HAS_IMAGE:
                at_pixels, mask = _at_pixels(grad_image, pixel, group + c, inside, channels)
                by_pixel = tl.load(at_pixels, mask=mask, other=0.0)
                own = _features(features, records, stride, at, group + c, channels)
                g = tl.dot(own, by_pixel, g, input_precision="ieee")
                by_own = tl.dot(shown, tl.trans(by_pixel), by_own, input_precision="ieee")
            tl.store(to, by_own, mask=(group + c < channels)[None, :])
        adds = shown * g
        hidden = behind[None, :] + tl.sum(tl.where(later[:, :, None], adds[None, :, :], 0.0), 1)
        behind += tl.sum(adds, 0)
        weight = tl.where(drawn & (unclamped <= alpha_max), tl.fma(after, g, -hidden) / through * falloff, 0.0)
        store_shape(moments + MOMENTS * at, u, v, weight)


@triton.jit(do_not_specialize=["count", "capacity"])
def sum_features(
    order,
    ends,
    boxes,
    places,
    by_features,
    channels,
    count,
    capacity,
    grad_features,
    GROUP: tl.constexpr,
    LANES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Sum dL/dfeature over each splat's slots, in a fixed order, as `sum_moments`: grad_features [N, channels]."""
    groups = tl.cdiv(channels, GROUP)
    rank = tl.program_id(0) // groups * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(0) % groups * GROUP + tl.arange(0, GROUP)
    here = rank < count
    i = tl.load(order + rank, mask=here, other=0)
    spoilt = tl.load(ends + count - 1) > capacity
    tiles = tl.where(spoilt, 0, tl.load(boxes + 3 * count + i, mask=here, other=0))
    begin = tl.where(spoilt, 0, tl.load(ends + rank, mask=here, other=0)).to(tl.int32) - tiles
    total = tl.zeros([BLOCK, GROUP], tl.float64)
    for first in range(0, tl.max(tiles, 0), LANES):
        j = first + tl.arange(0, LANES)[None, :]
        slot = begin[:, None] + j
        live = (j < tiles[:, None]) & (slot < capacity)
        place = tl.load(places + slot, mask=live, other=-1)
        live &= place >= 0
        values = by_features + place.to(tl.int64)[:, :, None] * channels + channel[None, None, :]
        mask = live[:, :, None] & (channel < channels)[None, None, :]
        total += tl.sum(tl.load(values, mask=mask, other=0.0).to(tl.float64), 1)
    to = grad_features + i[:, None] * channels + channel[None, :]
    tl.store(to, total.to(tl.float32), mask=here[:, None] & (channel < channels)[None, :])
