#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "splat/project.h"
#include "splat/scene.h"

// Depth order and tile lists.
namespace avatar::splat {

struct TileLists {
    std::vector<std::int64_t> tile_begin;   // [tiles + 1] into `pairs`; a tile's pairs are front to back
    std::vector<std::uint32_t> tile_order;  // [tiles] the tiles with most pairs first, so that threads end together
    std::vector<std::uint32_t> slot_begin;  // [Gaussians + 1]: the slots of a Gaussian
    std::unique_ptr<Pair[]> pairs;
    std::int64_t pair_count = 0;
};

// Memory for the spans of a few Gaussians.
class SpanStore {
public:
    static Span* take(void* store, std::int64_t count);  // as Projection::take

private:
    std::vector<std::unique_ptr<Span[]>> blocks_;
    Span* next_ = nullptr;
    std::int64_t left_ = 0;
};

// The visible of `count` Gaussians by increasing depth (> 0), equal depths by index.
std::vector<std::uint32_t> depth_order(const double* depths, const Visibility* visibility, std::int64_t count);

// The lists of the Gaussians `order`, front to back; lists.slot_begin is filled already. tiles_of[i / kRange] holds the
// tiles of kRange Gaussians, one Gaussian after the other.
constexpr std::int64_t kRange = 256;
void fill_tile_lists(const std::vector<std::uint32_t>& order, const std::vector<std::vector<std::uint32_t>>& tiles_of,
                     const TileGrid& grid, int threads, TileLists& lists);

}  // namespace avatar::splat
