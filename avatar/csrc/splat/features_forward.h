#pragma once
#include "splat/features_tile.h"

namespace avatar::splat {
namespace {

// sums [kChannels, kLanes] += features^T weights, over the chunk's splats that a block shows.
template <int kChannels>
inline void accumulate(const float (*weights)[kLanes], const float* const* features, int count, float* sums) {
    Floats sum[kChannels];
#pragma GCC unroll 8
    for (int c = 0; c < kChannels; ++c) sum[c] = load(sums + c * kLanes);
    for (int k = 0; k < count; ++k) {
        const Floats weight = load(weights[k]);
#pragma GCC unroll 8
        for (int c = 0; c < kChannels; ++c) sum[c] = fma(weight, broadcast(features[k][c]), sum[c]);
    }
#pragma GCC unroll 8
    for (int c = 0; c < kChannels; ++c) store(sums + c * kLanes, sum[c]);
}

void forward_features(const Raster& r, const FeatureChannels& f, std::int64_t tile, const ForwardTarget& target,
                      float* workspace) {
    const TileArea area(r, tile);
    enum { kTransmittance, kStops, kVectors };
    Pixels<kVectors> pixels;
    begin_pixels(area, r.width, pixels);
    Word inside[kWords], alive[kWords];
    area.blocks(inside);
    __builtin_memcpy(alive, inside, sizeof alive);

    const std::int64_t padded = whole_groups(f.channels);
    Workspace memory(workspace);
    float* const sums = memory.take(kTilePixels * padded);  // [kBlocks, padded, kLanes]
    float* const features = memory.take(kChunk * padded);
    float* const beyond = memory.take(padded);  // where the pixels outside the region go
    __builtin_memset(sums, 0, kTilePixels * padded * sizeof(float));

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), t_min = broadcast(r.t_min);
    const std::int64_t begin = r.tile_begin[tile], count = r.tile_begin[tile + 1] - begin;
    Word* const blocks_of_pairs = target.blocks + begin * kWords;
    __builtin_memset(blocks_of_pairs, 0, count * kWords * sizeof(Word));
    Chunk chunk;
    alignas(64) float weights[kChunk][kLanes];
    const float* shown[kChunk];  // features
    for (std::int64_t first = 0; first < count && !is_empty(alive); first += kChunk) {
        const int size = count - first < kChunk ? static_cast<int>(count - first) : kChunk;
        __builtin_memset(chunk.touched, 0, sizeof chunk.touched);
        for (int e = 0; e < size; ++e) {
            const std::int64_t at = begin + first + e;
            if (first + e + kAhead < count) __builtin_prefetch(r.splats + r.pairs[at + kAhead].splat);
            const std::int64_t splat = r.pairs[at].splat;
            const Local local = chunk.take(e, r.splats[splat], area);
            copy_padded(f.features + splat * f.channels, f.channels, padded, features + e * padded);
            const Blocks blocks(local, r.splats[splat].reach);
            for (int w = 0; w < kWords; ++w) chunk.touch(e, w, blocks.reached[w] & alive[w]);
        }
        chunk.sort_by_block();
        for (int block = 0; block < kBlocks; ++block) {
            if (chunk.touched[block] == 0) continue;
            const int w = block / 64;
            const Word bit = Word{1} << (block % 64);
            const Floats row = broadcast(float(block / kBlocksAcross));
            float* const p = pixels.of(block);
            Floats before = load(p);
            int drawn_here = 0;
            for (Word pairs = chunk.touched[block]; pairs != 0; pairs &= pairs - 1) {
                const int e = first_bit(pairs);
                Floats u, v;
                chunk.coordinates(e, row, block % kBlocksAcross, u, v);
                const Floats alpha = min(broadcast(chunk.opacities[e]) * falloff_at(u, v), alpha_max);
                const Floats next = fma(-before, alpha, before);
                const Ints hit = alpha >= alpha_min, enough = next >= t_min, drawn = hit & enough;
                if (signs(drawn) != 0) {
                    store(weights[drawn_here], (Floats)((Ints)(before * alpha) & drawn));
                    shown[drawn_here++] = features + e * padded;
                    blocks_of_pairs[(first + e) * kWords + w] |= bit;
                }
                const Ints stopping = hit & ~enough & (before > 0.0f);
                before = drawn ? next : before;
                if (signs(stopping) != 0) {
                    before = (Floats)((Ints)before | (stopping & sign_bits()));
                    store(p + kStops * kLanes,
                          stopping ? (Floats)(Ints{} + static_cast<int>(first + e)) : load(p + kStops * kLanes));
                    if (signs((Ints)before) == kAllLanes) {
                        alive[w] &= ~bit;
                        break;
                    }
                }
            }
            store(p, before);
            float* const sum = sums + block * padded * kLanes;
            std::int64_t c = 0;
            for (; c + 2 * kGroup <= padded; c += 2 * kGroup) {
                accumulate<2 * kGroup>(weights, shown, drawn_here, sum + c * kLanes);
                for (int k = 0; k < drawn_here; ++k) shown[k] += 2 * kGroup;
            }
            if (c < padded) accumulate<kGroup>(weights, shown, drawn_here, sum + c * kLanes);
        }
    }

    end_pixels(pixels, target.ends + tile * 2 * kTilePixels);
    for (int block = 0; block < kBlocks; ++block) {
        if ((inside[block / 64] >> (block % 64) & 1) == 0) continue;
        const Floats t = load(pixels.of(block));
        float *const sum = sums + block * padded * kLanes, *rows[kLanes];
        for (int c = 0; c < f.channels; ++c)
            store(sum + c * kLanes, load(sum + c * kLanes) + t * broadcast(f.background[c]));
        rows_of_block(area, r.width, block, target.image, f.channels, beyond, rows);
        transpose_out<kLanes>(reinterpret_cast<const float(*)[kLanes]>(sum), f.channels, rows);
    }
    area.for_each_row<kVectors>(r.width, [&](int i, std::int64_t pixel, int row_count) {
        for (int k = 0; k < row_count; ++k) target.alpha[pixel + k] = 1.0f - pixels.values[i + k];
    });
}

}  // namespace
}  // namespace avatar::splat
