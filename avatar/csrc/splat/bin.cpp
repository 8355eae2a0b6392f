#include "splat/bin.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>
#include <utility>

#include "thread_pool.h"

namespace avatar::splat {
Span* SpanStore::take(void* store, std::int64_t count) {
    auto& self = *static_cast<SpanStore*>(store);
    if (count > self.left_) {
        constexpr std::int64_t kBlock = 1024;
        self.left_ = std::max(count, kBlock);
        self.blocks_.emplace_back(new Span[self.left_]);
        self.next_ = self.blocks_.back().get();
    }
    self.left_ -= count;
    return std::exchange(self.next_, self.next_ + count);
}

std::vector<std::uint32_t> depth_order(const double* depths, const Visibility* visibility, std::int64_t count) {
    // Radix sort by the float above 0 nearest to the depth, whose bits order as integers do; then the few runs of equal
    // floats by the double.
    struct Key {
        std::uint32_t depth, index;
    };
    const std::unique_ptr<Key[]> memory(new Key[2 * count]);
    Key *keys = memory.get(), *other = keys + count;
    std::uint32_t least = ~std::uint32_t{0}, most = 0;
    std::int64_t visible = 0;
    for (std::int64_t i = 0; i < count; ++i) {
        if (visibility[i] != Visibility::kVisible) continue;
        const float depth = static_cast<float>(depths[i]);
        std::uint32_t bits;
        std::memcpy(&bits, &depth, sizeof bits);
        keys[visible++] = {bits, static_cast<std::uint32_t>(i)};
        least = std::min(least, bits);
        most = std::max(most, bits);
    }
    constexpr int kBits = 12, kBuckets = 1 << kBits;
    for (int shift = 0; visible > 0 && shift < 32 && (most - least) >> shift != 0; shift += kBits) {
        std::array<std::uint32_t, kBuckets> starts{};
        const auto bucket = [&](const Key& key) { return (key.depth - least) >> shift & (kBuckets - 1); };
        for (std::int64_t i = 0; i < visible; ++i) ++starts[bucket(keys[i])];
        std::uint32_t sum = 0;
        for (std::uint32_t& start : starts) sum += std::exchange(start, sum);
        for (std::int64_t i = 0; i < visible; ++i) other[starts[bucket(keys[i])]++] = keys[i];
        std::swap(keys, other);
    }
    std::vector<std::uint32_t> order(visible);
    for (std::int64_t begin = 0, end; begin < visible; begin = end) {
        for (end = begin; end < visible && keys[end].depth == keys[begin].depth; ++end) order[end] = keys[end].index;
        if (end - begin > 1)
            std::stable_sort(order.begin() + begin, order.begin() + end,
                             [&](std::uint32_t i, std::uint32_t j) { return depths[i] < depths[j]; });
    }
    return order;
}

void fill_tile_lists(const std::vector<std::uint32_t>& order,
                     const std::vector<std::vector<std::uint32_t>>& tiles_of, const TileGrid& grid, int threads,
                     TileLists& lists) {
    const std::int64_t tiles = grid.count(), count = static_cast<std::int64_t>(order.size());

    // A stable counting sort by tile. Where it is worth waking the threads, the splats are cut into one chunk for each;
    // a chunk counts its pairs for every tile, and then knows where its own begin. The result is the same for any number
    // of chunks.
    constexpr std::int64_t kWorthwhile = 1 << 15;
    const std::int64_t chunks = std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count / kWorthwhile));
    const std::int64_t chunk_size = (count + chunks - 1) / chunks;
    std::vector<std::uint32_t> next(chunks * tiles, 0);
    const auto for_each_pair = [&](std::int64_t chunk, const auto& visit) {
        const std::int64_t end = std::min((chunk + 1) * chunk_size, count);
        for (std::int64_t rank = chunk * chunk_size; rank < end; ++rank) {
            const std::int64_t index = order[rank], range = index / kRange;
            const std::uint32_t first = lists.slot_begin[range * kRange], last = lists.slot_begin[index + 1];
            const std::uint32_t* const tiles_here = tiles_of[range].data();
            for (std::uint32_t slot = lists.slot_begin[index]; slot < last; ++slot)
                visit(tiles_here[slot - first], Pair{static_cast<std::uint32_t>(index), slot});
        }
    };
    if (chunks == 1) {
        for (const std::vector<std::uint32_t>& some : tiles_of)
            for (const std::uint32_t tile : some) ++next[tile];
    } else {
        parallel_for(threads, chunks, 1, [&](std::int64_t chunk, std::int64_t) {
            std::uint32_t* const counts = next.data() + chunk * tiles;
            for_each_pair(chunk, [&](std::uint32_t tile, const Pair&) { ++counts[tile]; });
        });
    }

    lists.tile_begin.resize(tiles + 1);
    std::int64_t sum = 0;
    for (std::int64_t tile = 0; tile < tiles; ++tile) {
        lists.tile_begin[tile] = sum;
        for (std::int64_t chunk = 0; chunk < chunks; ++chunk)
            sum += std::exchange(next[chunk * tiles + tile], static_cast<std::uint32_t>(sum));
    }
    lists.tile_begin[tiles] = lists.pair_count = sum;
    lists.tile_order.resize(tiles);
    std::iota(lists.tile_order.begin(), lists.tile_order.end(), 0u);
    std::sort(lists.tile_order.begin(), lists.tile_order.end(), [&](std::uint32_t i, std::uint32_t j) {
        return lists.tile_begin[i + 1] - lists.tile_begin[i] > lists.tile_begin[j + 1] - lists.tile_begin[j];
    });
    lists.pairs.reset(new Pair[lists.pair_count]);  // not initialised: every element is written below
    parallel_for(threads, chunks, 1, [&](std::int64_t chunk, std::int64_t) {
        std::uint32_t* const position = next.data() + chunk * tiles;
        for_each_pair(chunk, [&](std::uint32_t tile, const Pair& pair) { lists.pairs[position[tile]++] = pair; });
    });
}

}  // namespace avatar::splat
