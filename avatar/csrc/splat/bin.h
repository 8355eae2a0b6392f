#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "splat/scene.h"

// Depth order and tile lists.
namespace avatar::splat {

struct TileLists {
    std::vector<std::int64_t> tile_begin;   // [tiles + 1] into `pairs`; a tile's pairs are front to back
    std::vector<std::uint32_t> tile_order;  // [tiles] the tiles with most pairs first, so that threads end together
    std::vector<std::int64_t> slot_begin;   // [splats + 1]: the slots of a splat
    std::unique_ptr<Pair[]> pairs;
    std::int64_t pair_count = 0;
};

// Indices 0 .. depths.size() - 1 by increasing depth (> 0), equal depths by index.
std::vector<std::uint32_t> depth_order(const std::vector<double>& depths);

// The tiles in which each of the sorted splats has a pixel centre that its ellipse of alpha >= alpha_min may contain.
// Throws std::length_error, naming the number and the limit, for more than `max_pairs` pairs.
TileLists build_tile_lists(const Splat* splats, std::int64_t count, const TileGrid& grid, std::int64_t max_pairs,
                           int threads);

// How many tiles other ways of choosing them would take: the box around the ellipse, and the square of three standard
// deviations of the longer axis.
std::int64_t tiles_of_box(const Splat& splat, const TileGrid& grid);
std::int64_t tiles_of_square(const Splat& splat, const TileGrid& grid);

}  // namespace avatar::splat
