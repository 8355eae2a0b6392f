#pragma once
// What the forward and the backward kernel share: the pixels of a tile, and the alpha of a splat at them. Both
// directions must make the same decisions (skipped, drawn, stopped) to the last bit, so both get them here.
#include "splat/raster.h"
#include "splat/simd.h"

namespace avatar::splat {
namespace {

constexpr int kTilePixels = kTileWidth * kTileHeight;
constexpr int kStrips = kTileWidth / kLanes;  // a tile is cut into strips as wide as a vector
static_assert(kTileWidth % kLanes == 0 && kTileHeight % kLanes == 0 && kTileHeight <= 32);

// The per-pixel arrays of a tile hold row after row; a vector is one row of one strip.
inline int vector_at(int row, int strip) { return row * kTileWidth + strip * kLanes; }

struct TileArea {
    TileArea(const Raster& r, std::int64_t tile)
        : left((r.grid.first_x + static_cast<int>(tile % r.grid.count_x)) * kTileWidth),
          top((r.grid.first_y + static_cast<int>(tile / r.grid.count_x)) * kTileHeight) {
        const Region& region = r.grid.region;
        first_column = region.left > left ? region.left - left : 0;
        first_row = region.top > top ? region.top - top : 0;
        end_column = region.right - left < kTileWidth ? region.right - left : kTileWidth;
        end_row = region.bottom - top < kTileHeight ? region.bottom - top : kTileHeight;
    }
    int left, top;                                     // of the tile in the image
    int first_column, first_row, end_column, end_row;  // the part of the tile inside the region
};

// One splat as seen from one tile.
struct SplatInTile {
    Floats u_lane[kStrips];  // u of a pixel is u_row[its row] + u_lane[its strip]
    Floats opacity;
    alignas(64) float u_row[kTileHeight];
    alignas(64) float v_row[kTileHeight];
    alignas(64) float minus_vv_row[kTileHeight];
    unsigned rows[kStrips];  // bit r: row r of the strip may have a pixel where alpha reaches alpha_min

    SplatInTile(const Splat& s, const TileArea& area) {
        const double dx = area.left + 0.5 - s.x, dy = area.top + 0.5 - s.y;
        const float a = float(s.a), b = float(s.b), c = float(s.c);
        const Floats u0 = broadcast(float(s.a * dx + s.b * dy)), v0 = broadcast(float(s.c * dy));
        const Floats reach = broadcast(s.reach), zero{};
        opacity = broadcast(s.opacity);
        for (int strip = 0; strip < kStrips; ++strip) {
            u_lane[strip] = broadcast(a) * (iota() + broadcast(float(strip * kLanes)));
            rows[strip] = 0;
        }
        for (int row = 0; row < kTileHeight; row += kLanes) {
            const Floats j = iota() + broadcast(float(row));
            const Floats u = fma(broadcast(b), j, u0), v = fma(broadcast(c), j, v0);
            const Floats vv = v * v;
            store(u_row + row, u);
            store(v_row + row, v);
            store(minus_vv_row + row, -vv);
            for (int strip = 0; strip < kStrips; ++strip) {
                // The point of this row of the strip that is nearest to the centre, in whitened coordinates; a > 0.
                const Floats first = u + broadcast(a * (strip * kLanes)), last = first + broadcast(a * (kLanes - 1));
                const Floats nearest = max(first, zero) + min(last, zero);
                rows[strip] |= signs(fma(nearest, nearest, vv) <= reach) << row;
            }
        }
    }

    // 2^-(u^2 + v^2) at the pixels of a vector; times the opacity it is the alpha before clamping.
    Floats falloff(int row, Floats u) const { return exp2_negative(fma(-u, u, broadcast(minus_vv_row[row]))); }
};

inline unsigned first_bit(unsigned bits) { return static_cast<unsigned>(__builtin_ctz(bits)); }

// Whether splats are skipped, drawn or end a pixel, and the transmittance behind them. A pixel that has stopped, or
// that is outside the region, is marked by the sign bit of its transmittance; nothing is drawn there any more.
struct Step {
    Ints drawn;
    Floats after;

    Step(Floats before, Floats alpha, Floats alpha_min, Floats t_min) {
        const Floats next = fma(-before, alpha, before);
        const Ints hit = alpha >= alpha_min, enough = next >= t_min;
        drawn = hit & enough;
        const Ints kept = (Ints)(drawn ? next : before);
        after = (Floats)(kept | (hit & ~enough & sign_bits()));
    }
};

inline void clear_transmittance(const TileArea& area, float* transmittance, unsigned alive[kStrips]) {
    for (int row = 0; row < kTileHeight; ++row)
        for (int column = 0; column < kTileWidth; ++column)
            transmittance[row * kTileWidth + column] = row >= area.first_row && row < area.end_row &&
                                                               column >= area.first_column && column < area.end_column
                                                           ? 1.0f
                                                           : -1.0f;
    const unsigned rows = (2u << (area.end_row - 1)) - (1u << area.first_row);
    for (int strip = 0; strip < kStrips; ++strip) {
        const bool inside = strip * kLanes < area.end_column && (strip + 1) * kLanes > area.first_column;
        alive[strip] = inside ? rows : 0;
    }
}

inline int bits_of(const unsigned alive[kStrips]) {
    int bits = 0;
    for (int strip = 0; strip < kStrips; ++strip) bits += __builtin_popcount(alive[strip]);
    return bits;
}

inline bool any_alive(const unsigned alive[kStrips]) {
    unsigned any = 0;
    for (int strip = 0; strip < kStrips; ++strip) any |= alive[strip];
    return any != 0;
}

}  // namespace
}  // namespace avatar::splat
