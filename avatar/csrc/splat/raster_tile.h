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
static_assert(kBlocksAcross == 8 && kLanes <= 2 * kBlocksAcross && kBlocks % 64 == 0 && kBlocks <= kMaxBlocks);

// The per-pixel arrays of a tile hold block after block, rows of blocks from the top.
inline int pixel_at(int row, int column) {
    const int block = row / kBlockHeight * kBlocksAcross + column / kBlockWidth;
    return block * kLanes + row % kBlockHeight * kBlockWidth + column % kBlockWidth;
}

constexpr int kAhead = 4;  // pairs, for which a splat is fetched before it is needed: they lie all over the memory

typedef unsigned long long Word;
inline int first_bit(Word bits) { return __builtin_ctzll(bits); }

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

    // Calls visit(index in the tile's arrays, index in the image) for the pixels of the region.
    template <typename Visit>
    void for_each_pixel(std::int64_t image_width, const Visit& visit) const {
        for (int row = first_row; row < end_row; ++row)
            for (int column = first_column; column < end_column; ++column)
                visit(pixel_at(row, column), (top + row) * image_width + left + column);
    }

    // The blocks that have a pixel in the region.
    void blocks(Word set[kWords]) const {
        const Word columns = (2u << ((end_column - 1) / kBlockWidth)) - (1u << (first_column / kBlockWidth));
        for (int w = 0; w < kWords; ++w) set[w] = 0;
        for (int y = first_row / kBlockHeight; y <= (end_row - 1) / kBlockHeight; ++y)
            set[y * kBlocksAcross / 64] |= columns << (y * kBlocksAcross % 64);
    }

    int left, top;                                     // of the tile in the image
    int first_column, first_row, end_column, end_row;  // the part of the tile inside the region
};

// One splat as seen from one tile.
struct SplatInTile {
    Floats opacity;
    Floats u_lane, v_lane;  // (u, v) of a pixel is that of its block's first pixel plus that of its lane
    alignas(64) float u_block[kBlocks], v_block[kBlocks];
    Word blocks[kWords];  // those that may have a pixel where alpha reaches alpha_min

    SplatInTile(const Splat& s, const TileArea& area) {
        const double dx = area.left + 0.5 - s.x, dy = area.top + 0.5 - s.y;
        const float a = float(s.a), b = float(s.b), c = float(s.c);
        opacity = broadcast(s.opacity);
        u_lane = fma(broadcast(b), lane_rows(), broadcast(a) * lane_columns());
        v_lane = broadcast(c) * lane_rows();

        // The ranges of u and v in a block (a and c are above 0), and their values nearest to the splat's centre.
        const float b_height = b * (kBlockHeight - 1);
        const Floats u_less = broadcast(b_height < 0.0f ? b_height : 0.0f);
        const Floats u_more = broadcast(a * (kBlockWidth - 1) + (b_height > 0.0f ? b_height : 0.0f));
        const Floats v_more = broadcast(c * (kBlockHeight - 1));
        const Floats b_step = broadcast(b * kBlockHeight), c_step = broadcast(c * kBlockHeight);
        const Floats u0 = broadcast(float(s.a * dx + s.b * dy)), v0 = broadcast(float(s.c * dy));
        const Floats reach = broadcast(s.reach), zero{};
        for (int w = 0; w < kWords; ++w) blocks[w] = 0;
        const Floats u_first = fma(broadcast(a * kBlockWidth), remainders(kBlocksAcross), u0);
        const auto test_rows = [&](int row) {  // this row of blocks, and the next where a vector holds two
            const Floats y = quotients(kBlocksAcross) + broadcast(float(row));
            const Floats v = fma(c_step, y, v0), nearest_v = max(v, zero) + min(v + v_more, zero);
            for (int column = 0; column < kBlocksAcross; column += kLanes) {
                const int block = row * kBlocksAcross + column;
                const Floats u = fma(b_step, y, u_first) + broadcast(a * (kBlockWidth * column));
                store(u_block + block, u);
                store(v_block + block, v);
                const Floats nearest_u = max(u + u_less, zero) + min(u + u_more, zero);
                const Ints reached = fma(nearest_u, nearest_u, nearest_v * nearest_v) <= reach;
                blocks[block / 64] |= Word(signs(reached)) << (block % 64);
            }
        };
        if (kLanes > kBlocksAcross) {
            for (int row = 0; row < kBlocksDown; row += 2) test_rows(row);
        } else {
            Word rows = 0;  // by v alone: most splats are much smaller than a tile
            for (int y = 0; y < kBlocksDown; y += kLanes) {
                const Floats v = fma(c_step, remainders(kLanes) + broadcast(float(y)), v0);
                const Floats nearest_v = max(v, zero) + min(v + v_more, zero);
                rows |= Word(signs(nearest_v * nearest_v <= reach)) << y;
            }
            for (; rows != 0; rows &= rows - 1) test_rows(first_bit(rows));
        }
    }

    Floats u(int block) const { return broadcast(u_block[block]) + u_lane; }
    Floats v(int block) const { return broadcast(v_block[block]) + v_lane; }

    // Times the opacity it is the alpha before clamping.
    static Floats falloff(Floats u, Floats v) { return exp2_negative(fma(-u, u, -(v * v))); }

private:
    static Floats lane_columns() { return remainders(kBlockWidth); }
    static Floats lane_rows() { return quotients(kBlockWidth); }
};

}  // namespace
}  // namespace avatar::splat
