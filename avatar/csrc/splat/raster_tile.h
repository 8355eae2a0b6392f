#pragma once
// What the forward and the backward kernel share: the pixels of a tile, and the alpha of a splat at them. Both
// directions must make the same decisions (skipped, drawn) to the last bit, so both get them here.
#include "exponential.h"
#include "splat/raster.h"

namespace avatar::splat {
namespace {

// A vector holds a block of pixels, as square as it can be: 4x1, 4x2 or 4x4. Of vectors of 16x1 a splat of the usual
// size would leave three quarters of the lanes without work.
constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlocksAcross = kTileWidth / kBlockWidth, kBlocksDown = kTileHeight / kBlockHeight;
constexpr int kBlocks = kBlocksAcross * kBlocksDown;
constexpr int kWords = kBlocks / 64;  // sets of blocks are kept as bits
static_assert(kBlocksAcross == 8 && kLanes <= 2 * kBlocksAcross && kBlocks % 64 == 0);

constexpr int kAhead = 4;  // pairs, for which a splat is fetched before it is needed: they lie all over the memory

inline int first_bit(Word bits) { return __builtin_ctzll(bits); }

inline bool is_empty(const Word set[kWords]) {
    Word any = 0;
    for (int w = 0; w < kWords; ++w) any |= set[w];
    return any == 0;
}

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

    bool is_whole() const {
        return first_column == 0 && first_row == 0 && end_column == kTileWidth && end_row == kTileHeight;
    }

    // The blocks that have a pixel in the region.
    void blocks(Word set[kWords]) const {
        const Word columns = (2u << ((end_column - 1) / kBlockWidth)) - (1u << (first_column / kBlockWidth));
        for (int w = 0; w < kWords; ++w) set[w] = 0;
        for (int y = first_row / kBlockHeight; y <= (end_row - 1) / kBlockHeight; ++y)
            set[y * kBlocksAcross / 64] |= columns << (y * kBlocksAcross % 64);
    }

    // Calls visit(i, pixel, count) for every row of a block that has `count` pixels in the region: where the block's first
    // vector (see Pixels) has the first of them, and its index in the image.
    template <int kVectors, typename Visit>
    void for_each_row(std::int64_t image_width, const Visit& visit) const {
        for (int row = first_row; row < end_row; ++row) {
            const int blocks = row / kBlockHeight * kBlocksAcross, lane = row % kBlockHeight * kBlockWidth;
            for (int x = first_column / kBlockWidth; x * kBlockWidth < end_column; ++x) {
                const int column = x * kBlockWidth, first = first_column > column ? first_column : column;
                const int end = end_column < column + kBlockWidth ? end_column : column + kBlockWidth;
                visit((blocks + x) * kVectors * kLanes + lane + first - column,
                      (top + row) * image_width + left + first, end - first);
            }
        }
    }

    int left, top;                                     // of the tile in the image
    int first_column, first_row, end_column, end_row;  // the part of the tile inside the region
};

// Some vectors for each block of a tile while it is worked on, those of a block side by side. Rows of blocks are stored
// from the top.
template <int kVectors>
struct alignas(64) Pixels {
    float values[kVectors * kTilePixels];

    float* of(int block) { return values + block * kVectors * kLanes; }
};

// One splat as seen from one tile: (u, v) of a pixel is (u0 + a d_x + b d_y, v0 + c d_y) at distance d from the centre
// of the tile's first pixel. That is found in two steps, for the first pixel of the pixel's block and from there.
struct Local {
    Local(const Splat& s, const TileArea& area) : a(float(s.a)), b(float(s.b)), c(float(s.c)) {
        const double dx = area.left + 0.5 - s.x, dy = area.top + 0.5 - s.y;
        u0 = float(s.a * dx + s.b * dy);
        v0 = float(s.c * dy);
    }

    // At the first pixels of blocks in these rows. The first row's u is that of as many columns as a vector has lanes.
    Floats first_row_u() const { return fma(broadcast(a * kBlockWidth), remainders(kBlocksAcross), broadcast(u0)); }
    Floats u(Floats row, Floats first_row) const { return fma(broadcast(b * kBlockHeight), row, first_row); }
    Floats u_to_column(int column) const { return broadcast(a * float(kBlockWidth * column)); }
    Floats v(Floats row) const { return fma(broadcast(c * kBlockHeight), row, broadcast(v0)); }

    // What is added in the lanes of a block.
    Floats u_lane() const {
        return fma(broadcast(b), quotients(kBlockWidth), broadcast(a) * remainders(kBlockWidth));
    }
    Floats v_lane() const { return broadcast(c) * quotients(kBlockWidth); }

    float a, b, c, u0, v0;
};

// The vectors of a tile's pixels from which the forward kernels start: the first is the transmittance, the second where
// the pixel stops. A pixel that has stopped, or that is outside the region, is marked by the sign bit of its transmittance;
// nothing is drawn there any more. All other vectors are 0.
template <int kVectors>
inline void begin_pixels(const TileArea& area, std::int64_t image_width, Pixels<kVectors>& pixels) {
    const bool whole = area.is_whole();
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        store(p, broadcast(whole ? 1.0f : -1.0f));
        store(p + kLanes, (Floats)(Ints{} + (whole ? kNeverStops : 0)));
        for (int k = 2; k < kVectors; ++k) store(p + k * kLanes, Floats{});
    }
    if (whole) return;
    area.for_each_row<kVectors>(image_width, [&](int i, std::int64_t, int count) {
        for (int k = i; k < i + count; ++k) {
            pixels.values[k] = 1.0f;
            __builtin_memcpy(pixels.values + k + kLanes, &kNeverStops, sizeof kNeverStops);
        }
    });
}

// Takes the marks off the transmittances, and keeps both vectors for the backward kernels.
template <int kVectors>
inline void end_pixels(Pixels<kVectors>& pixels, float* ends) {
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        store(p, (Floats)((Ints)load(p) & ~sign_bits()));
        for (int k = 0; k < 2; ++k) store_anywhere(ends + (2 * block + k) * kLanes, load(p + k * kLanes));
    }
}

// Times the opacity it is the alpha before clamping.
inline Floats falloff_at(Floats u, Floats v) { return exp2_negative(fma(-u, u, -(v * v))); }

}  // namespace
}  // namespace avatar::splat
