#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

template <bool kCount>
void forward_tile(const Raster& r, std::int64_t tile, const ForwardTarget& target) {
    const TileArea area(r, tile);
    alignas(64) float transmittance[kTilePixels], red[kTilePixels] = {}, green[kTilePixels] = {},
                                                  blue[kTilePixels] = {};
    unsigned alive[kStrips];
    clear_transmittance(area, transmittance, alive);
    TileCounts counts{};
    if (kCount) counts.rows = bits_of(alive);

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), t_min = broadcast(r.t_min);
    const std::int64_t begin = r.tile_begin[tile], end = r.tile_begin[tile + 1];
    std::int64_t at = begin;
    for (; at < end && any_alive(alive); ++at) {
        const Splat& s = r.splats[r.pairs[at].splat];
        const SplatInTile splat(s, area);
        const Floats s_red = broadcast(s.red), s_green = broadcast(s.green), s_blue = broadcast(s.blue);
        const std::int64_t composited_before = counts.pixels_composited;
        for (int strip = 0; strip < kStrips; ++strip) {
            for (unsigned rows = splat.rows[strip] & alive[strip]; rows != 0; rows &= rows - 1) {
                const int row = static_cast<int>(first_bit(rows)), i = vector_at(row, strip);
                const Floats u = broadcast(splat.u_row[row]) + splat.u_lane[strip];
                const Floats alpha = min(splat.opacity * splat.falloff(row, u), alpha_max);
                const Floats before = load(transmittance + i);
                const Step step(before, alpha, alpha_min, t_min);
                const Floats weight = (Floats)((Ints)(before * alpha) & step.drawn);
                store(red + i, fma(weight, s_red, load(red + i)));
                store(green + i, fma(weight, s_green, load(green + i)));
                store(blue + i, fma(weight, s_blue, load(blue + i)));
                store(transmittance + i, step.after);
                if (signs((Ints)step.after) == kAllLanes) alive[strip] &= ~(1u << row);
                if (kCount) {
                    counts.pixels_evaluated += kLanes;
                    counts.pixels_composited += __builtin_popcount(signs(step.drawn));
                }
            }
        }
        if (kCount) target.composited[r.pairs[at].slot] = counts.pixels_composited > composited_before;
    }
    if (kCount) {
        counts.rows_stopped = counts.rows - bits_of(alive);
        target.counts[tile] = counts;
    }
    target.processed[tile] = static_cast<std::uint32_t>(at - begin);

    for (int row = area.first_row; row < area.end_row; ++row) {
        const std::int64_t first = std::int64_t{area.top + row} * r.width + area.left;
        for (int column = area.first_column; column < area.end_column; ++column) {
            const int i = row * kTileWidth + column;
            const float t = __builtin_fabsf(transmittance[i]);
            float* pixel = target.image + 3 * (first + column);
            pixel[0] = red[i] + t * r.background[0];
            pixel[1] = green[i] + t * r.background[1];
            pixel[2] = blue[i] + t * r.background[2];
            target.alpha[first + column] = 1.0f - t;
            target.transmittance[first + column] = t;
        }
    }
}

}  // namespace
}  // namespace avatar::splat
