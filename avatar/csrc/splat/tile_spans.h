#pragma once
// Which tiles the ellipses of splats meet, for as many as a vector has doubles. Included only by the kernels.
#include "simd.h"
#include "splat/project.h"

namespace avatar::splat {
namespace {

// Splats without depth and colour, side by side.
struct alignas(64) Footprints {
    double x[kBatch], y[kBatch], a[kBatch], b[kBatch], c[kBatch];
    float reach[kBatch];
};

inline Doubles larger(Doubles a, Doubles b) { return a < b ? b : a; }  // a where one is NaN
inline Doubles between(Doubles value, Doubles low, Doubles high) {     // NaN stays
    return value < low ? low : high < value ? high : value;
}

// Of magnitudes below 2^51.
inline Doubles nearest_whole(Doubles v) {
    constexpr double rounder = 6755399441055744.0;  // 1.5 * 2^52
    return (v + rounder) - rounder;
}
inline Doubles round_down(Doubles v) {
    const Doubles whole = nearest_whole(v);
    return whole > v ? whole - 1.0 : whole;
}
inline Doubles round_up(Doubles v) {
    const Doubles whole = nearest_whole(v);
    return whole < v ? whole + 1.0 : whole;
}

// The first and the last pixel whose centre lies in [low, high], within [begin, end): whole numbers, first > last where
// there is none. An end that is NaN is taken for infinitely far.
struct PixelRange {
    PixelRange(Doubles low, Doubles high, int begin, int end) {
        const Doubles least = Doubles{} + double(begin), most = Doubles{} + double(end);
        const Doubles start = low - 0.5, stop = high - 0.5;
        first = round_up(start > least ? (start < most ? start : most) : least);
        last = round_down(stop < most - 1.0 ? larger(stop, least - 1.0) : most - 1.0);
    }
    Doubles first, last;
};

// The spans of `count` splats, of those that are visible, and how many tiles are in them. A span for each row of tiles
// that an ellipse reaches over, which may have no pixel in it.
inline void find_tiles(const Projection& to, const Footprints& from, const bool* visible, int count, TileSpans* tiles,
                       std::uint32_t* pair_counts) {
    constexpr double kHeight = kTileHeight, kWidth = kTileWidth;
    const TileGrid& grid = to.grid;
    alignas(64) double top[kBatch], bottom[kBatch];
    Span* place[kBatch];
    std::int64_t rows[kBatch], needed = 0;
    for (int at = 0; at < kBatch; at += kDoubles) {
        const Doubles y = load(from.y + at), radius = square_root(load_as_doubles(from.reach + at));
        const Doubles half = radius / load(from.c + at);
        const PixelRange pixels(y - half, y + half, grid.region.top, grid.region.bottom);
        store(top + at, pixels.first);
        store(bottom + at, pixels.last);
    }
    for (int lane = 0; lane < count; ++lane) {
        const bool any = visible[lane] && top[lane] <= bottom[lane];
        rows[lane] = any ? int(bottom[lane]) / kTileHeight - int(top[lane]) / kTileHeight + 1 : 0;
        needed += rows[lane];
    }
    for (int lane = count; lane < kBatch; ++lane) rows[lane] = 0;
    Span* memory = to.take(to.store, needed);
    std::uint32_t pairs[kBatch] = {};
    for (int lane = 0; lane < count; ++lane) {
        place[lane] = memory;
        memory += rows[lane];
        tiles[lane] = {place[lane], static_cast<std::uint32_t>(rows[lane])};
    }

    for (int at = 0; at < kBatch; at += kDoubles) {
        std::int64_t most = 0;
        for (int lane = at; lane < at + kDoubles; ++lane) most = rows[lane] > most ? rows[lane] : most;
        if (most == 0) continue;
        const Doubles x = load(from.x + at), y = load(from.y + at), a = load(from.a + at), b = load(from.b + at),
                      c = load(from.c + at), reach = load_as_doubles(from.reach + at), highest = load(top + at),
                      lowest = load(bottom + at);
        const Doubles radius = square_root(reach), skew = b / c;  // in whitened coordinates, u = a d_x + skew v
        // The ellipse's rightmost point has v = -extreme, its leftmost v = +extreme.
        const Doubles extreme = skew * radius / square_root(1.0 + skew * skew), inv_a = 1.0 / a;
        Doubles tile_row = round_down(highest * (1.0 / kHeight));
        for (std::int64_t row = 0; row < most; ++row, tile_row += 1.0) {
            const Doubles first_row = larger(highest, tile_row * kHeight), end = tile_row * kHeight + (kHeight - 1.0);
            const Doubles last_row = end < lowest ? end : lowest;
            const Doubles v0 = between(c * (first_row + 0.5 - y), -radius, radius);
            const Doubles v1 = between(c * (last_row + 0.5 - y), -radius, radius);
            const Doubles v_left = between(extreme, v0, v1), v_right = between(-extreme, v0, v1);
            const Doubles half_left = square_root(larger(reach - v_left * v_left, Doubles{}));
            const Doubles half_right = square_root(larger(reach - v_right * v_right, Doubles{}));
            const Doubles leftmost = x - (skew * v_left + half_left) * inv_a;
            const Doubles rightmost = x - (skew * v_right - half_right) * inv_a;
            const PixelRange pixels(leftmost, rightmost, grid.region.left, grid.region.right);
            const Doubles start = (tile_row - double(grid.first_y)) * double(grid.count_x) - double(grid.first_x);
            const Longs any = pixels.first <= pixels.last;
            alignas(64) double first_tile[kDoubles], last_tile[kDoubles];
            store(first_tile, any ? start + round_down(pixels.first * (1.0 / kWidth)) : Doubles{} + 1.0);
            store(last_tile, any ? start + round_down(pixels.last * (1.0 / kWidth)) : Doubles{});
            for (int lane = 0; lane < kDoubles; ++lane) {
                if (row >= rows[at + lane]) continue;
                Span& span = place[at + lane][row];
                span = {static_cast<std::uint32_t>(first_tile[lane]), static_cast<std::uint32_t>(last_tile[lane])};
                pairs[at + lane] += span.last + 1 - span.first;
            }
        }
    }
    for (int lane = 0; lane < count; ++lane) pair_counts[lane] = pairs[lane];
}

}  // namespace
}  // namespace avatar::splat
