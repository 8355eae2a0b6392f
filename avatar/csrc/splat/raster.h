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

constexpr int kNeverStops = 0x7fffffff;  // a pair's number

typedef unsigned long long Word;  // of a set of blocks, as bits

// Written at the pixels of the region only.
struct ForwardTarget {
    float* image;  // [height * width * channels]
    float* alpha;  // [height * width]
    // [tiles * 2 * kTilePixels], in the kernels' own order, the transmittance behind all splats, and the bits of a number:
    // the pair of the tile from which on the pixel shows none, 0 outside the region.
    float* ends;
    Word* blocks;  // [pairs * Kernels::words] that were looked at
};

struct BackwardSource {
    const float* ends;
    const Word* blocks;
    const float* grad_image;  // may be null
    const float* grad_alpha;  // may be null
};

struct BackwardTarget {
    float* moments;           // [pairs * kMoments], by slot; with features [pairs * (kShapeMoments + channels)]
    double* grad_background;  // [tiles * channels]
};

// What both directions read of features beside a Raster, whose background they do not.
struct FeatureChannels {
    const float* features;    // [N * channels]
    const float* background;  // [channels]
    int channels;
};

}  // namespace avatar::splat
