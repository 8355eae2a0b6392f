#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

// (u, v) at the pixels of a block.
class Coordinates {
public:
    explicit Coordinates(const Local& s) : s_(s), u_lane_(s.u_lane()), v_lane_(s.v_lane()) {
        store(first_row_, s.first_row_u());
    }

    Floats u(int block) const {
        const int x = block % kBlocksAcross;
        Floats first = s_.u(row_of(block), broadcast(first_row_[x % kLanes]));
        if constexpr (kLanes < kBlocksAcross) first += s_.u_to_column(x - x % kLanes);
        return first + u_lane_;
    }
    Floats v(int block) const { return s_.v(row_of(block)) + v_lane_; }

private:
    static Floats row_of(int block) {
        static constexpr float numbers[32] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                              16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
        static_assert(kBlocksDown <= 32);
        return broadcast(numbers[block / kBlocksAcross]);
    }

    const Local s_;
    const Floats u_lane_, v_lane_;
    alignas(64) float first_row_[kLanes];
};

// Back to front, from the last splat that each pixel shows. With g = dL/dcolour of a pixel, T_k the transmittance in
// front of splat k and A = 1 - T_end the alpha output, splat k's alpha has the gradient
//     T_k g.c_k - behind_k / (1 - alpha_k) = (T_{k+1} g.c_k - behind_k) / (1 - alpha_k),
//     behind_k = sum over j > k of T_j alpha_j g.c_j + T_end (g.background - dL/dA).
// `behind` is what was added to it, with nothing taken off again, and T_k = T_{k+1} / (1 - alpha_k) has a relative error
// of about 1e-7 for each splat, however small it is: 1 - alpha is exact or nearly so, and t_min keeps T_end in range.
void backward_tile(const Raster& r, std::int64_t tile, const BackwardSource& source, const BackwardTarget& target) {
    const TileArea area(r, tile);
    enum { kTransmittance, kStops, kBehind, kGradient, kVectors = kGradient + 3 };
    Pixels<kVectors> pixels;
    const float* const ends = source.ends + tile * 2 * kTilePixels;
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        for (int k = 0; k < 2; ++k) store(p + k * kLanes, load_anywhere(ends + (2 * block + k) * kLanes));
        for (int k = kBehind; k < kVectors; ++k) store(p + k * kLanes, Floats{});
    }
    area.for_each_row<kVectors>(r.width, [&](int i, std::int64_t pixel, int count) {
        float *const gradient = pixels.values + i + kGradient * kLanes;
        float *const behind = pixels.values + i + kBehind * kLanes;
        if (source.grad_image != nullptr && count == 4) {
            Four red, green, blue;
            load_interleaved(source.grad_image + 3 * pixel, red, green, blue);
            store_four(gradient, red);
            store_four(gradient + kLanes, green);
            store_four(gradient + 2 * kLanes, blue);
        } else if (source.grad_image != nullptr) {
            for (int k = 0; k < count; ++k)
                for (int c = 0; c < 3; ++c) gradient[k + c * kLanes] = source.grad_image[3 * (pixel + k) + c];
        }
        if (source.grad_alpha != nullptr)
            for (int k = 0; k < count; ++k) behind[k] = source.grad_alpha[pixel + k];
    });
    Floats ground_red{}, ground_green{}, ground_blue{};
    for (int block = 0; block < kBlocks; ++block) {
        float* const p = pixels.of(block);
        const Floats t = load(p + kTransmittance * kLanes), g_red = load(p + kGradient * kLanes),
                     g_green = load(p + (kGradient + 1) * kLanes), g_blue = load(p + (kGradient + 2) * kLanes);
        ground_red = fma(t, g_red, ground_red);
        ground_green = fma(t, g_green, ground_green);
        ground_blue = fma(t, g_blue, ground_blue);
        const Floats g_ground = fma(g_red, broadcast(r.background[0]),
                                    fma(g_green, broadcast(r.background[1]), g_blue * broadcast(r.background[2])));
        store(p + kBehind * kLanes, t * (g_ground - load(p + kBehind * kLanes)));
    }
    const Four ground = sums(ground_red, ground_green, ground_blue, ground_blue);
    for (int c = 0; c < 3; ++c) target.grad_background[3 * tile + c] = ground[c];

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), one = broadcast(1.0f);
    const std::int64_t begin = r.tile_begin[tile], count = r.tile_begin[tile + 1] - begin;
    const Word* const blocks_of_pairs = source.blocks + begin * kWords;
    for (std::int64_t at = count - 1; at >= 0; --at) {
        const Pair pair = r.pairs[begin + at];
        float* const moments = target.moments + std::int64_t{pair.slot} * kMoments;
        const Word* const blocks = blocks_of_pairs + at * kWords;
        if (is_empty(blocks)) {
            for (int k = 0; k < kMoments; ++k) moments[k] = 0.0f;
            continue;
        }
        if (at >= kAhead) __builtin_prefetch(r.splats + r.pairs[begin + at - kAhead].splat);
        const Splat& s = r.splats[pair.splat];
        const Coordinates coordinates(Local(s, area));
        const Floats opacity = broadcast(s.opacity), s_red = broadcast(s.red), s_green = broadcast(s.green),
                     s_blue = broadcast(s.blue);
        const Ints now = Ints{} + static_cast<int>(at);
        Floats moment[kMoments];
#pragma GCC unroll 9
        for (int k = 0; k < kMoments; ++k) moment[k] = Floats{};  // not {}: GCC calls on a slow instruction for that
        for (int w = 0; w < kWords; ++w) {
            for (Word bits = blocks[w]; bits != 0; bits &= bits - 1) {
                const int block = 64 * w + first_bit(bits);
                float* const p = pixels.of(block);
                const Floats u = coordinates.u(block), v = coordinates.v(block);
                const Floats falloff = falloff_at(u, v), unclamped = opacity * falloff;
                const Floats clamped = min(unclamped, alpha_max);
                const Ints drawn = (clamped >= alpha_min) & (now < (Ints)load(p + kStops * kLanes));
                const Floats alpha = (Floats)((Ints)clamped & drawn);
                const Floats g_red = load(p + kGradient * kLanes), g_green = load(p + (kGradient + 1) * kLanes),
                             g_blue = load(p + (kGradient + 2) * kLanes);
                const Floats g_colour = fma(g_red, s_red, fma(g_green, s_green, g_blue * s_blue));

                const Floats pass = one / (one - alpha), after = load(p), before = after * pass;
                const Floats shown = before * alpha, hidden = load(p + kBehind * kLanes);
                store(p, before);
                store(p + kBehind * kLanes, fma(shown, g_colour, hidden));
                const Floats grad_alpha = pass * fma(after, g_colour, -hidden);
                const Floats weight = (Floats)((Ints)(grad_alpha * falloff) & drawn & (unclamped <= alpha_max));

                const Floats weight_u = weight * u, weight_v = weight * v;
                moment[kWeight] += weight;
                moment[kU] += weight_u;
                moment[kUU] = fma(weight_u, u, moment[kUU]);
                moment[kV] += weight_v;
                moment[kUV] = fma(weight_u, v, moment[kUV]);
                moment[kVV] = fma(weight_v, v, moment[kVV]);
                moment[kRed] = fma(shown, g_red, moment[kRed]);
                moment[kGreen] = fma(shown, g_green, moment[kGreen]);
                moment[kBlue] = fma(shown, g_blue, moment[kBlue]);
            }
        }
        for (int k = 0; k + 4 <= kMoments; k += 4) {
            const Four four = sums(moment[k], moment[k + 1], moment[k + 2], moment[k + 3]);
            __builtin_memcpy(moments + k, &four, sizeof four);
        }
        moments[kBlue] = sums(moment[kBlue], moment[kBlue], moment[kBlue], moment[kBlue])[0];
        static_assert(kMoments % 4 == 1 && kBlue == kMoments - 1);
    }
}

}  // namespace
}  // namespace avatar::splat
