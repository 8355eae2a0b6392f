#pragma once
// What both directions of compositing features share.
//
// A tile's pairs are taken in chunks, and a chunk block by block: the values of a block's pixels stay in registers or in the
// first cache for all splats of the chunk, and a splat's alpha is found once for all channels. The channels are then
// products of small matrices: of a chunk's weights at the pixels and its features. Values are padded with zeros to whole
// groups of channels, or to whole vectors.
#include "splat/raster_forward.h"
#include "transpose.h"

namespace avatar::splat {
namespace {

constexpr int kChunk = 64;  // pairs: the bits of a word
constexpr int kGroup = 4;   // channels, or splats, at least, that are multiplied side by side

inline std::int64_t rounded_up(std::int64_t value, std::int64_t multiple) {
    return (value + multiple - 1) / multiple * multiple;
}
inline std::int64_t whole_groups(int channels) { return rounded_up(channels, kGroup); }
inline std::int64_t whole_vectors(int channels) { return rounded_up(channels, kLanes); }

// Parts of the workspace, each aligned to the vector.
class Workspace {
public:
    explicit Workspace(float* memory)
        : next_(reinterpret_cast<float*>(rounded_up(reinterpret_cast<std::intptr_t>(memory), 64))) {}

    float* take(std::int64_t floats) {
        float* const part = next_;
        next_ += rounded_up(floats, 16);
        return part;
    }

private:
    float* next_;
};

// Enough for either direction.
std::int64_t feature_workspace(int channels) {
    const std::int64_t groups = whole_groups(channels), vectors = whole_vectors(channels);
    const std::int64_t pixels = kTilePixels * (groups + vectors), pairs = (kChunk + 1) * (groups + vectors);
    return pixels + pairs + kLanes * groups + 2 * vectors + 8 * 16;
}

// A matrix of bits: bit c of word r becomes bit r of word c.
inline void transpose(Word words[64]) {
    Word low = 0xffffffffu;
    for (int j = 32; j != 0; j >>= 1, low ^= low << j)
        for (int begin = 0; begin < 64; begin += 2 * j)
            for (int k = begin; k < begin + j; ++k) {
                const Word swapped = ((words[k] >> j) ^ words[k + j]) & low;
                words[k + j] ^= swapped;
                words[k] ^= swapped << j;
            }
}

// The splats of a chunk as seen from the tile.
struct alignas(64) Chunk {
    // What follows of a Local.
    float u_lanes[kChunk][kLanes], v_lanes[kChunk][kLanes];
    float u0[kChunk], v0[kChunk], u_by_column[kChunk], u_by_row[kChunk], v_by_row[kChunk], opacities[kChunk];
    // First, by set of blocks and pair, the blocks in which the pair is looked at; transposed, by block, its pairs.
    Word touched[kBlocks];

    Local take(int e, const Splat& splat, const TileArea& area) {
        const Local s(splat, area);
        store(u_lanes[e], s.u_lane());
        store(v_lanes[e], s.v_lane());
        u0[e] = s.u0;
        v0[e] = s.v0;
        u_by_column[e] = s.a * kBlockWidth;
        u_by_row[e] = s.b * kBlockHeight;
        v_by_row[e] = s.c * kBlockHeight;
        opacities[e] = splat.opacity;
        return s;
    }
    void touch(int e, int w, Word blocks) { touched[64 * w + e] = blocks; }
    void sort_by_block() {
        for (int w = 0; w < kWords; ++w) transpose(touched + 64 * w);
    }

    // Of pair e at the pixels of a block in this row and column of blocks. The same bits as of Local's functions.
    void coordinates(int e, Floats row, int column, Floats& u, Floats& v) const {
        const Floats at_column = broadcast(float(column % kLanes));
        Floats first = fma(broadcast(u_by_row[e]), row, fma(broadcast(u_by_column[e]), at_column, broadcast(u0[e])));
        if constexpr (kLanes < kBlocksAcross) first += broadcast(u_by_column[e] * float(column - column % kLanes));
        u = first + load(u_lanes[e]);
        v = fma(broadcast(v_by_row[e]), row, broadcast(v0[e])) + load(v_lanes[e]);
    }
};

inline void copy_padded(const float* from, int count, std::int64_t padded, float* to) {
    std::int64_t k = 0;
    for (; k + kLanes <= count; k += kLanes) store_anywhere(to + k, load_anywhere(from + k));
    for (; k < count; ++k) to[k] = from[k];
    for (; k < padded; ++k) to[k] = 0.0f;
}

// Where the values of a block's pixels lie in an image of so many channels; `outside` for those beyond the region.
template <typename T>
inline void rows_of_block(const TileArea& area, std::int64_t image_width, int block, T* image, int channels, T* outside,
                          T* rows[kLanes]) {
    const int left = block % kBlocksAcross * kBlockWidth, top = block / kBlocksAcross * kBlockHeight;
    for (int lane = 0; lane < kLanes; ++lane) {
        const int column = left + lane % kBlockWidth, row = top + lane / kBlockWidth;
        const bool inside = column >= area.first_column && column < area.end_column && row >= area.first_row &&
                            row < area.end_row;
        rows[lane] = inside ? image + ((area.top + row) * image_width + area.left + column) * channels : outside;
    }
}

}  // namespace
}  // namespace avatar::splat
