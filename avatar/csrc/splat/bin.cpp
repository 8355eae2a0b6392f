#include "splat/bin.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numeric>
#include <stdexcept>
#include <string>

#include "thread_pool.h"

namespace avatar::splat {
namespace {

// The first and last pixel whose centre lies in [low, high], within [begin, end); first > last where there is none.
struct PixelRange {
    int first, last;
};

PixelRange pixels_between(double low, double high, int begin, int end) {
    const double first = std::ceil(low - 0.5), last = std::floor(high - 0.5);
    return {first > begin ? int(std::min(first, double(end))) : begin,
            last < end - 1.0 ? int(std::max(last, begin - 1.0)) : end - 1};
}

// Calls visit(first tile, last tile) for the rows of tiles that the splat's ellipse meets.
template <typename Visit>
void for_each_tile_row(const Splat& s, const TileGrid& grid, const Visit& visit) {
    const Region& region = grid.region;
    const double reach = s.reach;
    if (!std::isfinite(reach)) {
        for (std::int64_t tile = 0; tile < grid.count(); tile += grid.count_x) visit(tile, tile + grid.count_x - 1);
        return;
    }
    const double radius = std::sqrt(reach), skew = s.b / s.c;  // in whitened coordinates, u = a d_x + skew v
    const PixelRange rows = pixels_between(s.y - radius / s.c, s.y + radius / s.c, region.top, region.bottom);
    if (rows.first > rows.last) return;
    // The ellipse's rightmost point has v = -extreme, its leftmost v = +extreme.
    const double extreme = skew * radius / std::sqrt(1.0 + skew * skew), inv_a = 1.0 / s.a;
    for (int ty = rows.first / kTileHeight; ty <= rows.last / kTileHeight; ++ty) {
        const int top = std::max(rows.first, ty * kTileHeight);
        const int bottom = std::min(rows.last, ty * kTileHeight + kTileHeight - 1);
        const double v0 = std::clamp(s.c * (top + 0.5 - s.y), -radius, radius);
        const double v1 = std::clamp(s.c * (bottom + 0.5 - s.y), -radius, radius);
        const double v_left = std::clamp(extreme, v0, v1), v_right = std::clamp(-extreme, v0, v1);
        const double half_left = std::sqrt(std::max(reach - v_left * v_left, 0.0));
        const double half_right = std::sqrt(std::max(reach - v_right * v_right, 0.0));
        const double leftmost = s.x - (skew * v_left + half_left) * inv_a;
        const double rightmost = s.x - (skew * v_right - half_right) * inv_a;
        const PixelRange columns = pixels_between(leftmost, rightmost, region.left, region.right);
        const std::int64_t row = std::int64_t{ty - grid.first_y} * grid.count_x - grid.first_x;
        if (columns.first <= columns.last) visit(row + columns.first / kTileWidth, row + columns.last / kTileWidth);
    }
}

std::int64_t tiles_between(const Splat& s, double half_x, double half_y, const TileGrid& grid) {
    const Region& region = grid.region;
    const PixelRange columns = pixels_between(s.x - half_x, s.x + half_x, region.left, region.right);
    const PixelRange rows = pixels_between(s.y - half_y, s.y + half_y, region.top, region.bottom);
    if (columns.first > columns.last || rows.first > rows.last) return 0;
    return std::int64_t{columns.last / kTileWidth - columns.first / kTileWidth + 1} *
           (rows.last / kTileHeight - rows.first / kTileHeight + 1);
}

}  // namespace

std::int64_t tiles_of_box(const Splat& s, const TileGrid& grid) {
    const double radius = std::sqrt(double(s.reach));
    return tiles_between(s, radius * std::hypot(1.0, s.b / s.c) / s.a, radius / s.c, grid);
}

std::int64_t tiles_of_square(const Splat& s, const TileGrid& grid) {
    // The covariance is kHalfLog2E times the inverse of the squared factor (a, b; 0, c).
    const double yy = 1.0 / (s.c * s.c), xx = (1.0 + s.b * s.b * yy) / (s.a * s.a), det = yy / (s.a * s.a);
    const double middle = 0.5 * (xx + yy);
    const double longest = kHalfLog2E * (middle + std::sqrt(std::max(middle * middle - det, 0.0)));
    const double half = 3.0 * std::sqrt(longest);
    return tiles_between(s, half, half, grid);
}

std::vector<std::uint32_t> depth_order(const std::vector<double>& depths) {
    // Radix sort by the float above 0 nearest to the depth, whose bits order as integers do; then the few runs of equal
    // floats by the double.
    struct Key {
        std::uint32_t depth, index;
    };
    constexpr int kBits = 11, kBuckets = 1 << kBits;
    const std::size_t count = depths.size();
    std::vector<Key> keys(count), other(count);
    std::array<std::array<std::uint32_t, kBuckets>, 3> starts{};
    for (std::size_t i = 0; i < count; ++i) {
        const float depth = static_cast<float>(depths[i]);
        std::uint32_t bits;
        std::memcpy(&bits, &depth, sizeof bits);
        keys[i] = {bits, static_cast<std::uint32_t>(i)};
        for (int pass = 0; pass < 3; ++pass) ++starts[pass][bits >> (kBits * pass) & (kBuckets - 1)];
    }
    for (int pass = 0; pass < 3; ++pass) {
        std::uint32_t sum = 0;
        for (std::uint32_t& start : starts[pass]) {
            const std::uint32_t size = start;
            start = sum;
            sum += size;
        }
        for (const Key& key : keys) other[starts[pass][key.depth >> (kBits * pass) & (kBuckets - 1)]++] = key;
        keys.swap(other);
    }
    std::vector<std::uint32_t> order(count);
    for (std::size_t begin = 0, end; begin < count; begin = end) {
        for (end = begin; end < count && keys[end].depth == keys[begin].depth; ++end) order[end] = keys[end].index;
        if (end - begin > 1)
            std::stable_sort(order.begin() + begin, order.begin() + end,
                             [&](std::uint32_t i, std::uint32_t j) { return depths[i] < depths[j]; });
    }
    return order;
}

TileLists build_tile_lists(const Splat* splats, std::int64_t count, const TileGrid& grid, std::int64_t max_pairs,
                           int threads) {
    TileLists lists;
    const std::int64_t tiles = grid.count();

    // A stable counting sort by tile. The splats are cut into one chunk a thread; each chunk counts its pairs for every
    // splat and every tile, and then knows where its own begin. The result does not depend on the number of chunks.
    const std::int64_t chunks = std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count / 1024));
    const std::int64_t chunk_size = (count + chunks - 1) / chunks;
    std::vector<std::uint32_t> next(chunks * tiles, 0);
    const auto splats_of = [&](std::int64_t chunk) {
        return std::pair(std::min(chunk * chunk_size, count), std::min((chunk + 1) * chunk_size, count));
    };
    struct Span {
        std::uint32_t first, last;  // tiles next to each other in a row
    };
    std::vector<std::vector<Span>> spans(chunks);
    std::vector<std::uint32_t> span_count(count);
    lists.slot_begin.assign(count + 1, 0);
    parallel_for(threads, chunks, 1, [&](std::int64_t chunk, std::int64_t) {
        std::uint32_t* counts = next.data() + chunk * tiles;
        const auto [begin, end] = splats_of(chunk);
        std::vector<Span> found;
        found.reserve(4 * (end - begin));
        std::int64_t total = 0;
        for (std::int64_t i = begin; i < end; ++i) {
            const std::int64_t before = total;
            const std::size_t spans_before = found.size();
            for_each_tile_row(splats[i], grid, [&](std::int64_t first, std::int64_t last) {
                total += last - first + 1;
                if (total > max_pairs) return;  // refused below: only the number still matters
                found.push_back({static_cast<std::uint32_t>(first), static_cast<std::uint32_t>(last)});
                for (std::int64_t tile = first; tile <= last; ++tile) ++counts[tile];
            });
            span_count[i] = static_cast<std::uint32_t>(found.size() - spans_before);
            lists.slot_begin[i + 1] = total - before;
        }
        spans[chunk] = std::move(found);
    });
    for (std::int64_t i = 0; i < count; ++i) lists.slot_begin[i + 1] += lists.slot_begin[i];
    lists.pair_count = lists.slot_begin[count];
    if (lists.pair_count > max_pairs)
        throw std::length_error("drawing needs " + std::to_string(lists.pair_count) + " pairs of a tile of " +
                                std::to_string(kTileWidth) + "x" + std::to_string(kTileHeight) +
                                " pixels and a splat, the limit is " + std::to_string(max_pairs) +
                                "; are the scales too large for this camera?");

    lists.tile_begin.resize(tiles + 1);
    std::int64_t sum = 0;
    for (std::int64_t tile = 0; tile < tiles; ++tile) {
        lists.tile_begin[tile] = sum;
        for (std::int64_t chunk = 0; chunk < chunks; ++chunk) {
            const std::uint32_t size = next[chunk * tiles + tile];
            next[chunk * tiles + tile] = static_cast<std::uint32_t>(sum);
            sum += size;
        }
    }
    lists.tile_begin[tiles] = sum;
    lists.tile_order.resize(tiles);
    std::iota(lists.tile_order.begin(), lists.tile_order.end(), 0u);
    std::sort(lists.tile_order.begin(), lists.tile_order.end(), [&](std::uint32_t i, std::uint32_t j) {
        return lists.tile_begin[i + 1] - lists.tile_begin[i] > lists.tile_begin[j + 1] - lists.tile_begin[j];
    });
    lists.pairs.reset(new Pair[lists.pair_count]);  // not initialised: every element is written below
    parallel_for(threads, chunks, 1, [&](std::int64_t chunk, std::int64_t) {
        std::uint32_t* position = next.data() + chunk * tiles;
        const auto [begin, end] = splats_of(chunk);
        const Span* span = spans[chunk].data();
        for (std::int64_t i = begin; i < end; ++i) {
            std::uint32_t slot = static_cast<std::uint32_t>(lists.slot_begin[i]);
            for (const Span* const last_span = span + span_count[i]; span != last_span; ++span)
                for (std::uint32_t tile = span->first; tile <= span->last; ++tile)
                    lists.pairs[position[tile]++] = {static_cast<std::uint32_t>(i), slot++};
        }
    });
    return lists;
}

}  // namespace avatar::splat
