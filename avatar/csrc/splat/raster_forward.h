#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

inline int size_of(const Word set[kWords]) {
    int size = 0;
    for (int w = 0; w < kWords; ++w) size += __builtin_popcountll(set[w]);
    return size;
}

// Draws the pixels of one tile. What a splat needs at a block is a long chain of operations, and a processor looks ahead
// over less than two of those. So the work is cut into short loops over many blocks of some splats: which blocks, their
// alphas, and what these do to the pixels.
template <bool kCount>
class Painter {
public:
    Painter(const Raster& raster, std::int64_t tile) : r_(raster), area_(raster, tile) {
        const bool whole = area_.is_whole();
        for (int block = 0; block < kBlocks; ++block) {
            float* const p = pixels_ + block * kVectors * kLanes;
            store(p, broadcast(whole ? 1.0f : -1.0f));
            store(p + kStops * kLanes, (Floats)(Ints{} + (whole ? kNeverStops : 0)));
            for (int k = kRed; k <= kBlue; ++k) store(p + k * kLanes, Floats{});
        }
        if (!whole) {
            area_.for_each_pixel<kVectors>(r_.width, [&](int i, std::int64_t) {
                pixels_[i] = 1.0f;
                __builtin_memcpy(pixels_ + i + kStops * kLanes, &kNeverStops, sizeof kNeverStops);
            });
        }
        area_.blocks(alive_);
        if (kCount) counts_.blocks = size_of(alive_);
    }

    // Draws the pairs, front to back, until all blocks have stopped.
    void draw(const Pair* pairs, std::int64_t count, Word* drawn_blocks) {
        __builtin_memset(drawn_blocks, 0, count * kWords * sizeof(Word));
        std::int64_t first = 0;
        for (; first < count && !is_empty(alive_); first += kGroup) {
            const std::int64_t end = first + kGroup < count ? first + kGroup : count;
            find_candidates(pairs, first, end, count);
            for (int k = 0; k < candidates_; ++k) {
                for (int w = 0; w < kWords; ++w) drawn_blocks[group_[k].at * kWords + w] = group_[k].blocks[w];
                if (items_ + kBlocks > kMostItems) draw_items(drawn_blocks);
                for (int w = 0; w < kWords; ++w)
                    for (Word bits = group_[k].blocks[w]; bits != 0; bits &= bits - 1)
                        item_[items_++] = {static_cast<unsigned char>(k), static_cast<unsigned char>(64 * w + first_bit(bits))};
            }
            draw_items(drawn_blocks);
        }
        if (kCount) counts_.pairs_processed = first < count ? first : count;
    }

    void write(std::int64_t tile, const ForwardTarget& target) {
        float* const ends = target.ends + tile * 2 * kTilePixels;
        for (int block = 0; block < kBlocks; ++block) {
            float* const p = pixels_ + block * kVectors * kLanes;
            store(p, (Floats)((Ints)load(p) & ~sign_bits()));
            for (int k = 0; k < 2; ++k) store_anywhere(ends + (2 * block + k) * kLanes, load(p + k * kLanes));
        }
        area_.for_each_pixel<kVectors>(r_.width, [&](int i, std::int64_t pixel) {
            const float t = pixels_[i];
            for (int c = 0; c < 3; ++c)
                target.image[3 * pixel + c] = pixels_[i + (kRed + c) * kLanes] + t * r_.background[c];
            target.alpha[pixel] = 1.0f - t;
        });
        if (!kCount) return;
        counts_.blocks_stopped = counts_.blocks - size_of(alive_);
        target.counts[tile] = counts_;
    }

private:
    static constexpr int kGroup = 8;                 // pairs looked at together
    static constexpr int kMostItems = 2 * kBlocks;   // blocks of splats drawn together
    // A pixel that has stopped, or that is outside the region, is marked by the sign bit of its transmittance; nothing
    // is drawn there any more.
    enum { kTransmittance, kStops, kRed, kGreen, kBlue, kVectors };

    // A splat that may show, and in which blocks.
    struct Candidate {
        Coordinates coordinates;
        float opacity, red, green, blue;
        std::int64_t at;  // among the pairs of the tile
        Word blocks[kWords];
    };
    struct Item {
        unsigned char candidate, block;
    };

    void find_candidates(const Pair* pairs, std::int64_t first, std::int64_t end, std::int64_t count) {
        candidates_ = 0;
        for (std::int64_t at = first; at < end; ++at) {
            if (at + kAhead < count) __builtin_prefetch(r_.splats + pairs[at + kAhead].splat);
            const Splat& s = r_.splats[pairs[at].splat];
            const Local local(s, area_);
            Candidate& candidate = group_[candidates_];
            candidate.coordinates = Coordinates(local);
            candidate.opacity = s.opacity, candidate.red = s.red, candidate.green = s.green, candidate.blue = s.blue;
            candidate.at = at;
            find_blocks(local, s.reach, candidate.blocks);
            for (int w = 0; w < kWords; ++w) candidate.blocks[w] &= alive_[w];
            candidates_ += !is_empty(candidate.blocks);
        }
    }

    void draw_items(Word* drawn_blocks) {
        const Floats alpha_min = broadcast(r_.alpha_min), alpha_max = broadcast(r_.alpha_max), t_min = broadcast(r_.t_min);
        for (int i = 0; i < items_; ++i) {
            const Candidate& s = group_[item_[i].candidate];
            const int block = item_[i].block;
            const Floats falloff = falloff_at(s.coordinates.u(block), s.coordinates.v(block));
            store(alphas_ + i * kLanes, min(broadcast(s.opacity) * falloff, alpha_max));
        }
        for (int i = 0; i < items_; ++i) {
            const Candidate& s = group_[item_[i].candidate];
            float* const p = pixels_ + item_[i].block * kVectors * kLanes;
            const Floats alpha = load(alphas_ + i * kLanes), before = load(p), next = fma(-before, alpha, before);
            const Ints hit = alpha >= alpha_min, enough = next >= t_min, drawn = hit & enough;
            const Floats weight = (Floats)((Ints)(before * alpha) & drawn);
            const Ints stopping = hit & ~enough & (before > 0.0f);
            const Ints after = (Ints)(drawn ? next : before) | (stopping & sign_bits());
            store(p, (Floats)after);
            store(p + kRed * kLanes, fma(weight, broadcast(s.red), load(p + kRed * kLanes)));
            store(p + kGreen * kLanes, fma(weight, broadcast(s.green), load(p + kGreen * kLanes)));
            store(p + kBlue * kLanes, fma(weight, broadcast(s.blue), load(p + kBlue * kLanes)));
            store(p + kStops * kLanes, stopping ? (Floats)(Ints{} + static_cast<int>(s.at)) : load(p + kStops * kLanes));
            if (signs(after) == kAllLanes) alive_[item_[i].block / 64] &= ~(Word{1} << (item_[i].block % 64));
            if (kCount) {
                counts_.pixels_evaluated += kLanes;
                counts_.pixels_composited += __builtin_popcount(signs(drawn));
                if (signs(drawn) == 0) drawn_blocks[s.at * kWords + item_[i].block / 64] &= ~(Word{1} << (item_[i].block % 64));
            }
        }
        items_ = 0;
    }

    const Raster& r_;
    const TileArea area_;
    alignas(64) float pixels_[kVectors * kTilePixels];
    alignas(64) float alphas_[kMostItems * kLanes];
    Candidate group_[kGroup];
    Item item_[kMostItems];
    int candidates_ = 0, items_ = 0;
    Word alive_[kWords];
    TileCounts counts_{};
};

template <bool kCount>
void forward_tile(const Raster& r, std::int64_t tile, const ForwardTarget& target) {
    Painter<kCount> painter(r, tile);
    const std::int64_t begin = r.tile_begin[tile];
    painter.draw(r.pairs + begin, r.tile_begin[tile + 1] - begin, target.drawn_blocks + begin * kWords);
    painter.write(tile, target);
}

}  // namespace
}  // namespace avatar::splat
