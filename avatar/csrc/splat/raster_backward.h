#pragma once
#include "splat/raster_tile.h"

namespace avatar::splat {
namespace {

// Front to back, as the forward pass, so that the transmittance is found by the same products and not by division. With
// g = dL/dcolour of a pixel, splat k's alpha has the gradient
//     T_k g.c_k - behind_k / (1 - alpha_k),
//     behind_k = sum over j > k of T_j alpha_j g.c_j + T_end (g.background - dL/dA)
// where A = 1 - T_end is the alpha output; behind starts as the sum over all and loses each splat as it is passed.
void backward_tile(const Raster& r, std::int64_t tile, const BackwardSource& source, const BackwardTarget& target) {
    const TileArea area(r, tile);
    alignas(64) float transmittance[kTilePixels], behind[kTilePixels] = {};
    alignas(64) float grad_red[kTilePixels] = {}, grad_green[kTilePixels] = {}, grad_blue[kTilePixels] = {};
    unsigned alive[kStrips];
    clear_transmittance(area, transmittance, alive);

    double* grad_background = target.grad_background + 3 * tile;
    grad_background[0] = grad_background[1] = grad_background[2] = 0.0;
    for (int row = area.first_row; row < area.end_row; ++row) {
        const std::int64_t first = std::int64_t{area.top + row} * r.width + area.left;
        for (int column = area.first_column; column < area.end_column; ++column) {
            const int i = row * kTileWidth + column;
            const std::int64_t pixel = first + column;
            const float t = source.transmittance[pixel];
            if (source.grad_image != nullptr) {
                const float* g = source.grad_image + 3 * pixel;
                const float* image = source.image + 3 * pixel;
                grad_red[i] = g[0], grad_green[i] = g[1], grad_blue[i] = g[2];
                behind[i] = g[0] * image[0] + g[1] * image[1] + g[2] * image[2];
                for (int c = 0; c < 3; ++c) grad_background[c] += double(t) * g[c];
            }
            if (source.grad_alpha != nullptr) behind[i] -= source.grad_alpha[pixel] * t;
        }
    }

    const Floats alpha_min = broadcast(r.alpha_min), alpha_max = broadcast(r.alpha_max), t_min = broadcast(r.t_min);
    const Floats one = broadcast(1.0f);
    const std::int64_t begin = r.tile_begin[tile], end = r.tile_begin[tile + 1], stop = begin + source.processed[tile];
    for (std::int64_t at = begin; at < stop; ++at) {
        const Pair pair = r.pairs[at];
        const Splat& s = r.splats[pair.splat];
        const SplatInTile splat(s, area);
        const Floats s_red = broadcast(s.red), s_green = broadcast(s.green), s_blue = broadcast(s.blue);
        Floats sums[kMoments] = {};
        for (int strip = 0; strip < kStrips; ++strip) {
            for (unsigned rows = splat.rows[strip] & alive[strip]; rows != 0; rows &= rows - 1) {
                const int row = static_cast<int>(first_bit(rows)), i = vector_at(row, strip);
                const Floats u = broadcast(splat.u_row[row]) + splat.u_lane[strip];
                const Floats falloff = splat.falloff(row, u), unclamped = splat.opacity * falloff;
                const Floats alpha = min(unclamped, alpha_max);
                const Floats before = load(transmittance + i);
                const Step step(before, alpha, alpha_min, t_min);
                store(transmittance + i, step.after);
                if (signs((Ints)step.after) == kAllLanes) alive[strip] &= ~(1u << row);

                const Floats g_red = load(grad_red + i), g_green = load(grad_green + i), g_blue = load(grad_blue + i);
                const Floats g_colour = fma(g_red, s_red, fma(g_green, s_green, g_blue * s_blue));
                const Floats drawn = (Floats)((Ints)(before * alpha) & step.drawn);
                const Floats remaining = fma(-drawn, g_colour, load(behind + i));
                store(behind + i, remaining);
                const Floats grad_alpha = fma(before, g_colour, -(remaining / (one - alpha)));
                const Floats weight = (Floats)((Ints)(grad_alpha * falloff) & step.drawn & (unclamped <= alpha_max));

                const Floats v = broadcast(splat.v_row[row]), vv = broadcast(splat.minus_vv_row[row]);
                const Floats weight_u = weight * u;
                sums[kWeight] += weight;
                sums[kU] += weight_u;
                sums[kUU] = fma(weight_u, u, sums[kUU]);
                sums[kV] = fma(weight, v, sums[kV]);
                sums[kUV] = fma(weight_u, v, sums[kUV]);
                sums[kVV] = fma(-weight, vv, sums[kVV]);
                sums[kRed] = fma(drawn, g_red, sums[kRed]);
                sums[kGreen] = fma(drawn, g_green, sums[kGreen]);
                sums[kBlue] = fma(drawn, g_blue, sums[kBlue]);
            }
        }
        float* moments = target.moments + std::int64_t{pair.slot} * kMoments;
        for (int k = 0; k < kMoments; ++k) moments[k] = sum(sums[k]);
    }
    for (std::int64_t at = stop; at < end; ++at) {
        float* moments = target.moments + std::int64_t{r.pairs[at].slot} * kMoments;
        for (int k = 0; k < kMoments; ++k) moments[k] = 0.0f;
    }
}

}  // namespace
}  // namespace avatar::splat
