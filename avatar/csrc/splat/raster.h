#pragma once
#include <cstdint>

#include "splat/scene.h"

// Compositing of the tiles, forward and backward: what the kernels (kernels.h) take and give.
namespace avatar::splat {

// What both directions read.
struct Raster {
    const Splat* splats;  // [N]
    const Pair* pairs;
    const std::int64_t* tile_begin;
    TileGrid grid;
    int width;  // of the image
    float alpha_min, alpha_max, t_min;
    float background[3];
};

// What drawing one tile took; see Counts in splat.h.
struct TileCounts {
    std::int64_t pixels_evaluated, pixels_composited;
    std::int32_t blocks, blocks_stopped;
};

// The kernels work on blocks of as many pixels as a vector has lanes; at least 4.
constexpr int kMaxBlocks = kTilePixels / 4;
constexpr int kNeverStops = 0x7fffffff;

// The forward pass on a tile ends after `processed` pairs, when all its pairs are done or all its blocks have stopped.
struct TileEnd {
    std::uint32_t processed, stopped_blocks;
};

// All pixels of `block` have stopped when pair `at` of the tile, which none of them shows, has been looked at.
struct BlockStop {
    std::uint32_t at, block;
};

// Written at the pixels of the region only.
struct ForwardTarget {
    float* image;               // [height * width * 3]
    float* alpha;               // [height * width]
    float* transmittance;       // [tiles * kTilePixels], in the kernels' own order, as is the next
    int* stops;                 // the pair of the tile from which on the pixel shows none, 0 outside the region
    TileEnd* ends;              // [tiles]
    BlockStop* block_stops;     // [tiles * kMaxBlocks], the first `stopped_blocks` of each tile, by `at`
    TileCounts* counts;         // [tiles]; written by count_tile only, as is the next
    unsigned char* composited;  // [pairs], by slot: whether any pixel shows the splat
};

struct BackwardSource {
    const float* transmittance;
    const int* stops;
    const TileEnd* ends;
    const BlockStop* block_stops;
    const float* grad_image;  // may be null
    const float* grad_alpha;  // may be null
};

struct BackwardTarget {
    float* moments;           // [pairs * kMoments], by slot
    double* grad_background;  // [tiles * 3]
};

}  // namespace avatar::splat
