"""From splats to each tile's list of them, without a number that the host would have to read.

A pair is a splat in a tile; slots count the pairs splat by splat, front to back, and sorting them by tile (stably) gives
the lists. All buffers hold a fixed capacity. Where more pairs are needed there are none at all, and the drawing is NaN.
"""

import triton
import triton.language as tl

FIELDS = tl.constexpr(9)  # of a record: u and v of the tile's first pixel; a, b, c, opacity; red, green, blue
# With features the splat's number stands in the place of red, as bits, and there are no more.
FEATURE_FIELDS = tl.constexpr(7)


@triton.jit(do_not_specialize=["count", "capacity", "stride", "steps", "first_x", "first_y", "across", "tiles"])
def expand(
    order,
    ends,
    boxes,
    ellipses,
    looks,
    count,
    capacity,
    stride,
    steps,
    first_x,
    first_y,
    across,
    tiles,
    keys,
    splats,
    corners,
    records,
    FEATURES: tl.constexpr,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """For every slot: its tile as `keys` (`tiles` where there is none), its splat, and (u, v) of the tile's first pixel.

    order   int64 [N], splats front to back;  ends  int64 [N], running sum of their numbers of tiles
    steps   of the search through `ends`: the bits of N
    keys    int16 or int32 [capacity];  splats  int32 [capacity];  corners  float32 [2, capacity]
    A tile in which the splat reaches alpha_min nowhere is left out here, if that is easily seen.
    The colours (with FEATURES the splats' numbers) of all `stride` records are cleared: a chunk reaches over the end of its
    tile's list, and a product of nothing with what the memory held before could be NaN.
    """
    slot = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    total = tl.load(ends + count - 1)
    live = (slot < total) & (total <= capacity)

    # The first splat whose last slot is behind this one. Programs behind the last pair search for nothing.
    steps = tl.where(tl.program_id(0) * BLOCK < total, steps, 0)
    low = tl.zeros([BLOCK], tl.int32)
    high = low + count - 1
    for _ in range(steps):
        middle = (low + high) // 2
        behind = tl.load(ends + middle, mask=live, other=0) > slot
        high = tl.where(behind, middle, high)
        low = tl.where(behind, low, tl.minimum(middle + 1, high))
    splat = tl.load(order + low, mask=live, other=0).to(tl.int32)
    tiles_of_splat = tl.load(boxes + 3 * count + splat, mask=live, other=1)
    tiles_x = tl.load(boxes + 2 * count + splat, mask=live, other=1)
    local = slot - (tl.load(ends + low, mask=live, other=0).to(tl.int32) - tiles_of_splat)
    column = tl.load(boxes + splat, mask=live, other=0) + local % tiles_x
    row = tl.load(boxes + count + splat, mask=live, other=0) + local // tiles_x

    a = tl.load(ellipses + 2 * count + splat, mask=live, other=1.0)
    b = tl.load(ellipses + 3 * count + splat, mask=live, other=0.0)
    c = tl.load(ellipses + 4 * count + splat, mask=live, other=1.0)
    d_x = ((first_x + column) * TILE).to(tl.float64) + 0.5 - tl.load(ellipses + splat, mask=live, other=0.0)
    d_y = ((first_y + row) * TILE).to(tl.float64) + 0.5 - tl.load(ellipses + count + splat, mask=live, other=0.0)
    u, v = (a * d_x + b * d_y).to(tl.float32), (c * d_y).to(tl.float32)

    # The values of (u, v) in the tile that are nearest to the splat's centre, with room for rounding.
    reach = tl.load(looks + count + splat, mask=live, other=0.0)
    step_u, step_b, step_v = a.to(tl.float32) * (TILE - 1), b.to(tl.float32) * (TILE - 1), c.to(tl.float32) * (TILE - 1)
    slack_u, slack_v = 1e-6 * (tl.abs(u) + step_u + tl.abs(step_b)), 1e-6 * (tl.abs(v) + step_v)
    least_u, most_u = u + tl.minimum(step_b, 0.0) - slack_u, u + step_u + tl.maximum(step_b, 0.0) + slack_u
    nearest_u = tl.maximum(least_u, 0.0) + tl.minimum(most_u, 0.0)
    nearest_v = tl.maximum(v - slack_v, 0.0) + tl.minimum(v + step_v + slack_v, 0.0)
    live &= nearest_u * nearest_u + nearest_v * nearest_v <= reach

    if FEATURES:
        tl.store(records + 6 * stride + slot, tl.zeros([BLOCK], tl.float32), mask=slot < stride)
    else:
        for field in tl.static_range(6, FIELDS):
            tl.store(records + field * stride + slot, tl.zeros([BLOCK], tl.float32), mask=slot < stride)
    here = slot < capacity
    tl.store(keys + slot, tl.where(live, row * across + column, tiles).to(keys.dtype.element_ty), mask=here)
    tl.store(splats + slot, splat, mask=here)
    tl.store(corners + slot, u, mask=here)
    tl.store(corners + capacity + slot, v, mask=here)


@triton.jit
def first_record(begin, tile, CHUNK: tl.constexpr):
    """Where the records of a tile begin whose list begins at pair `begin`: at a multiple of CHUNK, behind the last tile's.

    A list of n pairs takes at most as many chunks as its own rounding and the one between the tiles leave.
    """
    return ((begin + CHUNK - 1) // CHUNK + tile) * CHUNK


@triton.jit(do_not_specialize=["count", "capacity", "stride", "tiles"])
def gather(
    sorted_keys,
    permutation,
    begins,
    splats,
    corners,
    ellipses,
    looks,
    count,
    capacity,
    stride,
    tiles,
    records,
    places,
    FEATURES: tl.constexpr,
    CHUNK: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Lay the pairs of each tile side by side.

    sorted_keys [capacity], permutation int64 [capacity]: of the slots, by tile;  begins  int32 [tiles + 1], by pair
    records  float32 [9 or 7, stride], see FIELDS;  places  int32 [capacity], where each slot's record is, -1: nowhere
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < capacity
    tile = tl.load(sorted_keys + i, mask=here, other=0).to(tl.int32)
    slot = tl.load(permutation + i, mask=here, other=0)
    live = here & (tile < tiles)
    begin = tl.load(begins + tile, mask=live, other=0)
    place = first_record(begin, tile, CHUNK) + i - begin
    tl.store(places + slot, tl.where(live, place, -1), mask=here)

    splat = tl.load(splats + slot, mask=live, other=0)
    tl.store(records + place, tl.load(corners + slot, mask=live, other=0.0), mask=live)
    tl.store(records + stride + place, tl.load(corners + capacity + slot, mask=live, other=0.0), mask=live)
    for k in tl.static_range(3):
        value = tl.load(ellipses + (2 + k) * count + splat, mask=live, other=0.0)
        tl.store(records + (2 + k) * stride + place, value.to(tl.float32), mask=live)
    tl.store(records + 5 * stride + place, tl.load(looks + splat, mask=live, other=0.0), mask=live)
    if FEATURES:
        tl.store(records + 6 * stride + place, splat.to(tl.float32, bitcast=True), mask=live)
    else:
        for k in tl.static_range(3):
            value = tl.load(looks + (2 + k) * count + splat, mask=live, other=0.0)
            tl.store(records + (6 + k) * stride + place, value, mask=live)
