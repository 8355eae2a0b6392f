#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

// (u, v) at the first pixels of blocks, and which blocks may have a pixel where alpha reaches alpha_min. The former are
// there for the rows of the latter only.
struct Blocks {
    alignas(64) float u[kBlocks], v[kBlocks];
    Word reached[kWords];

    Blocks(const Local& s, float reach) {
        // The ranges of u and v in a block (a and c are above 0), and their values nearest to the splat's centre.
        const float b_height = s.b * (kBlockHeight - 1);
        const Floats u_less = broadcast(b_height < 0.0f ? b_height : 0.0f);
        const Floats u_more = broadcast(s.a * (kBlockWidth - 1) + (b_height > 0.0f ? b_height : 0.0f));
        const Floats v_more = broadcast(s.c * (kBlockHeight - 1)), within = broadcast(reach), zero{};
        for (int w = 0; w < kWords; ++w) reached[w] = 0;
        const Floats first_row = s.first_row_u();
        const auto test_rows = [&](int row) {  // this row of blocks, and the next where a vector holds two
            const Floats y = quotients(kBlocksAcross) + broadcast(float(row));
            const Floats own_v = s.v(y), nearest_v = max(own_v, zero) + min(own_v + v_more, zero);
            for (int column = 0; column < kBlocksAcross; column += kLanes) {
                const int block = row * kBlocksAcross + column;
                const Floats own_u = s.u(y, first_row) + s.u_to_column(column);
                store(u + block, own_u);
                store(v + block, own_v);
                const Floats nearest_u = max(own_u + u_less, zero) + min(own_u + u_more, zero);
                const unsigned found = at_most(fma(nearest_u, nearest_u, nearest_v * nearest_v), within);
                reached[block / 64] |= Word(found) << (block % 64);
            }
        };
        if (kLanes > kBlocksAcross) {
            for (int row = 0; row < kBlocksDown; row += 2) test_rows(row);
        } else {
            Word rows = 0;  // by v alone: most splats are much smaller than a tile
            for (int y = 0; y < kBlocksDown; y += kLanes) {
                const Floats own_v = s.v(remainders(kLanes) + broadcast(float(y)));
                const Floats nearest_v = max(own_v, zero) + min(own_v + v_more, zero);
                rows |= Word(at_most(nearest_v * nearest_v, within)) << y;
            }
            for (; rows != 0; rows &= rows - 1) test_rows(first_bit(rows));
        }
    }
};

void forward_tile(const Raster& r, std::int64_t tile, const ForwardTarget& target) {
    const TileArea area(r, tile);
    enum { kTransmittance, kStops, kRed, kGreen, kBlue, kVectors };
    Pixels<kVectors> pixels;
    begin_pixels(area, r.width, pixels);
    Word alive[kWords];
    area.blocks(alive);

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), t_min = broadcast(r.t_min);
    const std::int64_t begin = r.tile_begin[tile], count = r.tile_begin[tile + 1] - begin;
    Word* const blocks_of_pairs = target.blocks + begin * kWords;
    std::int64_t at = 0;
    for (; at < count && !is_empty(alive); ++at) {
        const Pair pair = r.pairs[begin + at];
        if (at + kAhead < count) __builtin_prefetch(r.splats + r.pairs[begin + at + kAhead].splat);
        const Splat& s = r.splats[pair.splat];
        const Local local(s, area);
        const Blocks blocks(local, s.reach);
        const Floats u_lane = local.u_lane(), v_lane = local.v_lane(), opacity = broadcast(s.opacity);
        const Floats s_red = broadcast(s.red), s_green = broadcast(s.green), s_blue = broadcast(s.blue);
        for (int w = 0; w < kWords; ++w) {
            const Word looked_at = blocks.reached[w] & alive[w];
            blocks_of_pairs[at * kWords + w] = looked_at;
            for (Word bits = looked_at; bits != 0; bits &= bits - 1) {
                const int bit = first_bit(bits), block = 64 * w + bit;
                float* const p = pixels.of(block);
                const Floats u = broadcast(blocks.u[block]) + u_lane, v = broadcast(blocks.v[block]) + v_lane;
                const Floats alpha = min(opacity * falloff_at(u, v), alpha_max);
                const Floats before = load(p), next = fma(-before, alpha, before);
                const Ints hit = alpha >= alpha_min, enough = next >= t_min, drawn = hit & enough;
                const Floats weight = (Floats)((Ints)(before * alpha) & drawn);
                store(p + kRed * kLanes, fma(weight, s_red, load(p + kRed * kLanes)));
                store(p + kGreen * kLanes, fma(weight, s_green, load(p + kGreen * kLanes)));
                store(p + kBlue * kLanes, fma(weight, s_blue, load(p + kBlue * kLanes)));
                const Floats after = drawn ? next : before;
                store(p, after);
                const Ints stopping = hit & ~enough & (before > 0.0f);
                if (signs(stopping) != 0) {
                    const Ints stopped = (Ints)after | (stopping & sign_bits());
                    store(p, (Floats)stopped);
                    store(p + kStops * kLanes,
                          stopping ? (Floats)(Ints{} + static_cast<int>(at)) : load(p + kStops * kLanes));
                    if (signs(stopped) == kAllLanes) alive[w] &= ~(Word{1} << bit);
                }
            }
        }
    }
    __builtin_memset(blocks_of_pairs + at * kWords, 0, (count - at) * kWords * sizeof(Word));

    end_pixels(pixels, target.ends + tile * 2 * kTilePixels);
    area.for_each_row<kVectors>(r.width, [&](int i, std::int64_t pixel, int count) {
        const float* const p = pixels.values + i;
        float *const image = target.image + 3 * pixel, *const alpha = target.alpha + pixel;
        if (count == 4) {
            const Four t = load_four(p);
            store_four(alpha, 1.0f - t);
            store_interleaved(image, load_four(p + kRed * kLanes) + t * r.background[0],
                              load_four(p + kGreen * kLanes) + t * r.background[1],
                              load_four(p + kBlue * kLanes) + t * r.background[2]);
            return;
        }
        for (int k = 0; k < count; ++k) {
            for (int c = 0; c < 3; ++c) image[3 * k + c] = p[k + (kRed + c) * kLanes] + p[k] * r.background[c];
            alpha[k] = 1.0f - p[k];
        }
    });
}

}  // namespace
}  // namespace avatar::splat
