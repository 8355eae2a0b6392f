#pragma once
#include <cstdint>

#include "splat/scene.h"

// Compositing of the tiles, forward and backward. The kernels are compiled for several instruction sets and chosen when
// the program runs.
namespace avatar::splat {

// What both directions read.
struct Raster {
    const Splat* splats;
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
    std::int32_t rows, rows_stopped;
};

// Written at the pixels of the region only.
struct ForwardTarget {
    float* image;              // [height * width * 3]
    float* alpha;              // [height * width]
    float* transmittance;      // [height * width]
    std::uint32_t* processed;  // [tiles], pairs that were looked at before all pixels of the tile had stopped
    TileCounts* counts;         // [tiles]; written by count_tile only, as is the next
    unsigned char* composited;  // [pairs], by slot: whether any pixel shows the splat
};

struct BackwardSource {
    const float* image;
    const float* transmittance;
    const std::uint32_t* processed;
    const float* grad_image;  // may be null
    const float* grad_alpha;  // may be null
};

struct BackwardTarget {
    float* moments;           // [pairs * kMoments], by slot
    double* grad_background;  // [tiles * 3]
};

struct Kernels {
    void (*forward_tile)(const Raster&, std::int64_t tile, const ForwardTarget&);
    void (*count_tile)(const Raster&, std::int64_t tile, const ForwardTarget&);  // draws as forward_tile and counts
    void (*backward_tile)(const Raster&, std::int64_t tile, const BackwardSource&, const BackwardTarget&);
};

// The kernels for a name that choose_instruction_set() takes.
const Kernels& select_kernels(const char* name);

}  // namespace avatar::splat
