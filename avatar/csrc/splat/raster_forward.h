#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

inline int size_of(const Word set[kWords]) {
    int size = 0;
    for (int w = 0; w < kWords; ++w) size += __builtin_popcountll(set[w]);
    return size;
}

inline bool is_empty(const Word set[kWords]) {
    Word any = 0;
    for (int w = 0; w < kWords; ++w) any |= set[w];
    return any == 0;
}

template <bool kCount>
void forward_tile(const Raster& r, std::int64_t tile, const ForwardTarget& target) {
    const TileArea area(r, tile);
    // A pixel that has stopped, or that is outside the region, is marked by the sign bit of its transmittance; nothing
    // is drawn there any more.
    alignas(64) float transmittance[kTilePixels];
    alignas(64) float red[kTilePixels] = {}, green[kTilePixels] = {}, blue[kTilePixels] = {};
    alignas(64) int stops[kTilePixels];
    const bool whole = area.is_whole();
    for (int i = 0; i < kTilePixels; i += kLanes) {
        store(transmittance + i, broadcast(whole ? 1.0f : -1.0f));
        store(stops + i, Ints{} + (whole ? kNeverStops : 0));
    }
    if (!whole) {
        area.for_each_pixel(r.width, [&](int i, std::int64_t) {
            transmittance[i] = 1.0f;
            stops[i] = kNeverStops;
        });
    }
    Word alive[kWords];
    area.blocks(alive);
    TileCounts counts{};
    if (kCount) counts.blocks = size_of(alive);
    TileEnd& tile_end = target.ends[tile];
    tile_end.stopped_blocks = 0;

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), t_min = broadcast(r.t_min);
    const std::int64_t begin = r.tile_begin[tile], count = r.tile_begin[tile + 1] - begin;
    std::int64_t at = 0;
    for (; at < count && !is_empty(alive); ++at) {
        const Pair pair = r.pairs[begin + at];
        if (at + kAhead < count) __builtin_prefetch(r.splats + r.pairs[begin + at + kAhead].splat);
        const Splat& s = r.splats[pair.splat];
        const SplatInTile splat(s, area);
        const Floats s_red = broadcast(s.red), s_green = broadcast(s.green), s_blue = broadcast(s.blue);
        const std::int64_t composited_before = counts.pixels_composited;
        for (int w = 0; w < kWords; ++w) {
            for (Word bits = splat.blocks[w] & alive[w]; bits != 0; bits &= bits - 1) {
                const int bit = first_bit(bits), block = 64 * w + bit, i = block * kLanes;
                const Floats falloff = SplatInTile::falloff(splat.u(block), splat.v(block));
                const Floats alpha = min(splat.opacity * falloff, alpha_max);
                const Floats before = load(transmittance + i), next = fma(-before, alpha, before);
                const Ints hit = alpha >= alpha_min, enough = next >= t_min, drawn = hit & enough;
                const Floats weight = (Floats)((Ints)(before * alpha) & drawn);
                store(red + i, fma(weight, s_red, load(red + i)));
                store(green + i, fma(weight, s_green, load(green + i)));
                store(blue + i, fma(weight, s_blue, load(blue + i)));
                const Floats after = drawn ? next : before;
                store(transmittance + i, after);
                const Ints stopping = hit & ~enough & ~(Ints)before;
                if (signs(stopping) != 0) {
                    const Ints stopped = (Ints)after | (stopping & sign_bits());
                    store(transmittance + i, (Floats)stopped);
                    store(stops + i, stopping < 0 ? Ints{} + static_cast<int>(at) : load(stops + i));
                    if (signs(stopped) == kAllLanes) {
                        alive[w] &= ~(Word{1} << bit);
                        target.block_stops[tile * kMaxBlocks + tile_end.stopped_blocks++] = {
                            static_cast<std::uint32_t>(at), static_cast<std::uint32_t>(block)};
                    }
                }
                if (kCount) {
                    counts.pixels_evaluated += kLanes;
                    counts.pixels_composited += __builtin_popcount(signs(drawn));
                }
            }
        }
        if (kCount) target.composited[pair.slot] = counts.pixels_composited > composited_before;
    }
    tile_end.processed = static_cast<std::uint32_t>(at);
    if (kCount) {
        counts.blocks_stopped = counts.blocks - size_of(alive);
        target.counts[tile] = counts;
    }

    for (int i = 0; i < kTilePixels; i += kLanes)
        store(transmittance + i, (Floats)((Ints)load(transmittance + i) & ~sign_bits()));
    __builtin_memcpy(target.transmittance + tile * kTilePixels, transmittance, sizeof transmittance);
    __builtin_memcpy(target.stops + tile * kTilePixels, stops, sizeof stops);
    area.for_each_pixel(r.width, [&](int i, std::int64_t pixel) {
        const float t = transmittance[i];
        target.image[3 * pixel] = red[i] + t * r.background[0];
        target.image[3 * pixel + 1] = green[i] + t * r.background[1];
        target.image[3 * pixel + 2] = blue[i] + t * r.background[2];
        target.alpha[pixel] = 1.0f - t;
    });
}

}  // namespace
}  // namespace avatar::splat
