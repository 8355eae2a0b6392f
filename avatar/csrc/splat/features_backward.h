#pragma once
#include "splat/features_tile.h"

namespace avatar::splat {
namespace {

// The sums of a chunk's pairs over the blocks of the tile.
struct alignas(64) ChunkMoments {
    float values[kChunk][kShapeMoments][kLanes];
};

// dots[j] = sum over channels of features[j] * gradient [channels, kLanes], for a few splats at a block's pixels.
inline void dot_features(const float* const features[kGroup], const float* gradient, int channels, Floats dots[kGroup]) {
    Floats sum[kGroup];
#pragma GCC unroll 4
    for (int j = 0; j < kGroup; ++j) sum[j] = Floats{};
    for (int c = 0; c < channels; ++c) {
        const Floats g = load(gradient + c * kLanes);
#pragma GCC unroll 4
        for (int j = 0; j < kGroup; ++j) sum[j] = fma(g, broadcast(features[j][c]), sum[j]);
    }
#pragma GCC unroll 4
    for (int j = 0; j < kGroup; ++j) dots[j] = sum[j];
}

// to[j] += shown[j] [kLanes] * rows [kLanes, padded], kWide vectors of channels.
template <int kWide>
inline void add_features(const float shown[kGroup][kLanes], const float* rows, std::int64_t padded,
                         float* const to[kGroup], std::int64_t c) {
    Floats sum[kGroup][kWide];
#pragma GCC unroll 4
    for (int j = 0; j < kGroup; ++j)
        for (int k = 0; k < kWide; ++k) sum[j][k] = load(to[j] + c + k * kLanes);
#pragma GCC unroll 4
    for (int lane = 0; lane < kLanes; ++lane) {
        Floats g[kWide];
        for (int k = 0; k < kWide; ++k) g[k] = load(rows + lane * padded + c + k * kLanes);
#pragma GCC unroll 4
        for (int j = 0; j < kGroup; ++j)
            for (int k = 0; k < kWide; ++k) sum[j][k] = fma(broadcast(shown[j][lane]), g[k], sum[j][k]);
    }
#pragma GCC unroll 4
    for (int j = 0; j < kGroup; ++j)
        for (int k = 0; k < kWide; ++k) store(to[j] + c + k * kLanes, sum[j][k]);
}

// As backward_tile.
void backward_features(const Raster& r, const FeatureChannels& f, std::int64_t tile, const BackwardSource& source,
                       const BackwardTarget& target, float* workspace) {
    const TileArea area(r, tile);
    enum { kTransmittance, kStops, kBehind, kVectors };
    Pixels<kVectors> pixels;
    const float* const ends = source.ends + tile * 2 * kTilePixels;
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        for (int k = 0; k < 2; ++k) store(p + k * kLanes, load_anywhere(ends + (2 * block + k) * kLanes));
        store(p + kBehind * kLanes, Floats{});
    }
    if (source.grad_alpha != nullptr)
        area.for_each_row<kVectors>(r.width, [&](int i, std::int64_t pixel, int count) {
            for (int k = 0; k < count; ++k)
                pixels.values[i + kBehind * kLanes + k] = source.grad_alpha[pixel + k];
        });

    const std::int64_t padded = whole_groups(f.channels), wide = whole_vectors(f.channels);
    Workspace memory(workspace);
    float* const by_channel = memory.take(kTilePixels * padded);  // dL/dimage [kBlocks, padded, kLanes]
    float* const by_pixel = memory.take(kTilePixels * wide);      // the same [kBlocks, kLanes, wide]
    float* const features = memory.take((kChunk + 1) * padded);   // the last row is 0
    float* const gradients = memory.take((kChunk + 1) * wide);    // of the features; the last row is not read
    float* const ground = memory.take(kLanes * padded);
    float* const zeros = memory.take(wide);
    __builtin_memset(ground, 0, kLanes * padded * sizeof(float));
    __builtin_memset(zeros, 0, wide * sizeof(float));
    __builtin_memset(features + kChunk * padded, 0, padded * sizeof(float));
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        float* const gradient = by_channel + block * padded * kLanes;
        const float* rows[kLanes];
        if (source.grad_image != nullptr)
            rows_of_block<const float>(area, r.width, block, source.grad_image, f.channels, zeros, rows);
        else
            for (int lane = 0; lane < kLanes; ++lane) rows[lane] = zeros;
        for (int lane = 0; lane < kLanes; ++lane)
            copy_padded(rows[lane], f.channels, wide, by_pixel + (block * kLanes + lane) * wide);
        transpose_in<kLanes>(rows, f.channels, reinterpret_cast<float(*)[kLanes]>(gradient));
        const Floats t = load(p + kTransmittance * kLanes);
        Floats g_ground{};
        for (int c = 0; c < f.channels; ++c) {
            const Floats g = load(gradient + c * kLanes);
            g_ground = fma(g, broadcast(f.background[c]), g_ground);
            store(ground + c * kLanes, fma(t, g, load(ground + c * kLanes)));
        }
        store(p + kBehind * kLanes, t * (g_ground - load(p + kBehind * kLanes)));
    }
    for (int c = 0; c < f.channels; ++c) {
        const Floats own = load(ground + c * kLanes);
        target.grad_background[f.channels * tile + c] = sums(own, own, own, own)[0];
    }

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), one = broadcast(1.0f);
    const std::int64_t begin = r.tile_begin[tile], count = r.tile_begin[tile + 1] - begin;
    const Word* const blocks_of_pairs = source.blocks + begin * kWords;
    const std::int64_t stride = kShapeMoments + f.channels;
    Chunk chunk;
    ChunkMoments moments;
    alignas(64) float shown[kGroup][kLanes];
    for (std::int64_t first = (count - 1) / kChunk * kChunk; count > 0 && first >= 0; first -= kChunk) {
        const int size = count - first < kChunk ? static_cast<int>(count - first) : kChunk;
        __builtin_memset(chunk.touched, 0, sizeof chunk.touched);
        for (int e = 0; e < size; ++e) {
            const Word* const blocks = blocks_of_pairs + (first + e) * kWords;
            if (is_empty(blocks)) continue;
            const std::int64_t splat = r.pairs[begin + first + e].splat;
            chunk.take(e, r.splats[splat], area);
            copy_padded(f.features + splat * f.channels, f.channels, padded, features + e * padded);
            for (int k = 0; k < kShapeMoments; ++k) store(moments.values[e][k], Floats{});
            __builtin_memset(gradients + e * wide, 0, wide * sizeof(float));
            for (int w = 0; w < kWords; ++w) chunk.touch(e, w, blocks[w]);
        }
        chunk.sort_by_block();
        for (int block = 0; block < kBlocks; ++block) {
            if (chunk.touched[block] == 0) continue;
            float* const p = pixels.of(block);
            const Floats row = broadcast(float(block / kBlocksAcross));
            const Ints stops = (Ints)load(p + kStops * kLanes);
            Floats transmittance = load(p), hidden = load(p + kBehind * kLanes);
            for (Word pairs = chunk.touched[block]; pairs != 0;) {
                int numbers[kGroup], taken = 0;
                const float* feature_rows[kGroup];
                float* gradient_rows[kGroup];
                for (int j = 0; j < kGroup; ++j) {
                    numbers[j] = kChunk;  // none
                    if (pairs != 0) {
                        numbers[j] = 63 - __builtin_clzll(pairs);
                        pairs ^= Word{1} << numbers[j];
                        ++taken;
                    }
                    feature_rows[j] = features + numbers[j] * padded;
                    gradient_rows[j] = gradients + numbers[j] * wide;
                    store(shown[j], Floats{});
                }
                Floats dots[kGroup];
                dot_features(feature_rows, by_channel + block * padded * kLanes, f.channels, dots);
                for (int j = 0; j < taken; ++j) {
                    const int e = numbers[j];
                    Floats u, v;
                    chunk.coordinates(e, row, block % kBlocksAcross, u, v);
                    const Floats falloff = falloff_at(u, v), unclamped = broadcast(chunk.opacities[e]) * falloff;
                    const Floats clamped = min(unclamped, alpha_max);
                    const Ints drawn = (clamped >= alpha_min) & (Ints{} + static_cast<int>(first + e) < stops);
                    const Floats alpha = (Floats)((Ints)clamped & drawn);

                    const Floats pass = one / (one - alpha), after = transmittance;
                    transmittance = after * pass;
                    const Floats own = transmittance * alpha;
                    store(shown[j], own);
                    const Floats grad_alpha = pass * fma(after, dots[j], -hidden);
                    hidden = fma(own, dots[j], hidden);
                    const Floats weight = (Floats)((Ints)(grad_alpha * falloff) & drawn & (unclamped <= alpha_max));

                    const Floats weight_u = weight * u, weight_v = weight * v;
                    float(*const to)[kLanes] = moments.values[e];
                    store(to[kWeight], load(to[kWeight]) + weight);
                    store(to[kU], load(to[kU]) + weight_u);
                    store(to[kUU], fma(weight_u, u, load(to[kUU])));
                    store(to[kV], load(to[kV]) + weight_v);
                    store(to[kUV], fma(weight_u, v, load(to[kUV])));
                    store(to[kVV], fma(weight_v, v, load(to[kVV])));
                }
                const float* const rows = by_pixel + block * kLanes * wide;
                std::int64_t c = 0;
                for (; c + 2 * kLanes <= wide; c += 2 * kLanes) add_features<2>(shown, rows, wide, gradient_rows, c);
                if (c < wide) add_features<1>(shown, rows, wide, gradient_rows, c);
            }
            store(p, transmittance);
            store(p + kBehind * kLanes, hidden);
        }
        for (int e = 0; e < size; ++e) {
            float* const to = target.moments + r.pairs[begin + first + e].slot * stride;
            if (is_empty(blocks_of_pairs + (first + e) * kWords)) {
                __builtin_memset(to, 0, stride * sizeof(float));
                continue;
            }
            const auto own = [&](int k) { return load(moments.values[e][k]); };
            const Four low = sums(own(0), own(1), own(2), own(3)), high = sums(own(4), own(5), own(4), own(5));
            store_four(to, low);
            to[4] = high[0];
            to[5] = high[1];
            static_assert(kShapeMoments == 6);
            __builtin_memcpy(to + kShapeMoments, gradients + e * wide, f.channels * sizeof(float));
        }
    }
}

}  // namespace
}  // namespace avatar::splat
