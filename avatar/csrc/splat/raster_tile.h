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

// While it is worked on, a tile holds some vectors for each block, side by side: if each had an array of its own, the
// places of a block would lie whole pages apart, which the processor takes for the same place until it has compared all of
// their addresses. Rows of blocks are stored from the top. The index of a pixel's value in the first vector of its block:
template <int kVectors>
inline int pixel_at(int row, int column) {
    const int block = row / kBlockHeight * kBlocksAcross + column / kBlockWidth;
    return block * kVectors * kLanes + row % kBlockHeight * kBlockWidth + column % kBlockWidth;
}

constexpr int kAhead = 4;  // pairs, for which a splat is fetched before it is needed: they lie all over the memory

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

    // Calls visit(pixel_at, index in the image) for the pixels of the region.
    template <int kVectors, typename Visit>
    void for_each_pixel(std::int64_t image_width, const Visit& visit) const {
        for (int row = first_row; row < end_row; ++row)
            for (int column = first_column; column < end_column; ++column)
                visit(pixel_at<kVectors>(row, column), (top + row) * image_width + left + column);
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

// One splat as seen from one tile: (u, v) of a pixel is (u0 + a d_x + b d_y, v0 + c d_y) at distance d from the centre of
// the tile's first pixel.
struct Local {
    float a, b, c, u0, v0;

    Local() = default;
    Local(const Splat& s, const TileArea& area) : a(float(s.a)), b(float(s.b)), c(float(s.c)) {
        const double dx = area.left + 0.5 - s.x, dy = area.top + 0.5 - s.y;
        u0 = float(s.a * dx + s.b * dy);
        v0 = float(s.c * dy);
    }
};

// (u, v) of the pixels of a block: that of the block's first pixel plus that of the lane.
class Coordinates {
public:
    Coordinates() = default;
    explicit Coordinates(const Local& s)
        : a_(s.a), u_lane_(fma(broadcast(s.b), lane_rows(), broadcast(s.a) * lane_columns())),
          v_lane_(broadcast(s.c) * lane_rows()), u_step_(broadcast(s.b * kBlockHeight)),
          v_step_(broadcast(s.c * kBlockHeight)), v0_(broadcast(s.v0)) {
        store(u_first_, first_u(s));
    }

    Floats u(int block) const {
        const int x = block % kBlocksAcross;
        Floats first = fma(u_step_, row_of(block), broadcast(u_first_[x % kLanes]));
        if constexpr (kLanes < kBlocksAcross) first += broadcast(a_ * float(kBlockWidth * (x - x % kLanes)));
        return first + u_lane_;
    }
    Floats v(int block) const { return fma(v_step_, row_of(block), v0_) + v_lane_; }

    // u at the first pixel of as many blocks of the first row as a vector has lanes.
    static Floats first_u(const Local& s) {
        return fma(broadcast(s.a * kBlockWidth), remainders(kBlocksAcross), broadcast(s.u0));
    }

private:
    static Floats lane_columns() { return remainders(kBlockWidth); }
    static Floats lane_rows() { return quotients(kBlockWidth); }
    static Floats row_of(int block) { return broadcast(kWholeNumbers[block / kBlocksAcross]); }
    static constexpr float kWholeNumbers[32] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                                16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
    static_assert(kBlocksDown <= 32);

    float a_;
    Floats u_lane_, v_lane_, u_step_, v_step_, v0_;
    alignas(64) float u_first_[kLanes];
};

// The blocks that may have a pixel where alpha reaches alpha_min: u^2 + v^2 <= reach.
inline void find_blocks(const Local& s, float within, Word blocks[kWords]) {
    // The ranges of u and v in a block (a and c are above 0), and their values nearest to the splat's centre.
    const float b_height = s.b * (kBlockHeight - 1);
    const Floats u_less = broadcast(b_height < 0.0f ? b_height : 0.0f);
    const Floats u_more = broadcast(s.a * (kBlockWidth - 1) + (b_height > 0.0f ? b_height : 0.0f));
    const Floats v_more = broadcast(s.c * (kBlockHeight - 1));
    const Floats b_step = broadcast(s.b * kBlockHeight), c_step = broadcast(s.c * kBlockHeight);
    const Floats v0 = broadcast(s.v0), reach = broadcast(within), zero{};
    for (int w = 0; w < kWords; ++w) blocks[w] = 0;
    const Floats u_first = Coordinates::first_u(s);
    const auto test_rows = [&](int row) {  // this row of blocks, and the next where a vector holds two
        const Floats y = quotients(kBlocksAcross) + broadcast(float(row));
        const Floats v = fma(c_step, y, v0), nearest_v = max(v, zero) + min(v + v_more, zero);
        for (int column = 0; column < kBlocksAcross; column += kLanes) {
            const int block = row * kBlocksAcross + column;
            const Floats u = fma(b_step, y, u_first) + broadcast(s.a * (kBlockWidth * column));
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

// Times the opacity it is the alpha before clamping.
inline Floats falloff_at(Floats u, Floats v) { return exp2_negative(fma(-u, u, -(v * v))); }

inline bool is_empty(const Word set[kWords]) {
    Word any = 0;
    for (int w = 0; w < kWords; ++w) any |= set[w];
    return any == 0;
}

}  // namespace
}  // namespace avatar::splat
