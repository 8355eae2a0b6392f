#pragma once
// The folded heads: one affine map of the latent for each Gaussian. Included only by kernels.cpp.
#include "hyper/kernels.h"
#include "simd.h"

namespace avatar::hyper {
namespace {

// In vectors of four floats, which every instruction set has: with wider ones a Gaussian's ten values fit no better.
void apply(const float* matrix, const float* bias, const float* latents, std::int64_t n, std::int64_t begin,
           std::int64_t end, float* out) {
    for (std::int64_t g = begin; g < end; ++g) {
        const float *rows = matrix + g * n * kOffsets, *z = latents + g * n, *start = bias + g * kOffsets;
        // Values 0-3, 4-7 and 6-9: an overlap is cheaper than a rest.
        Four a[2] = {load_four(start), {}}, b[2] = {load_four(start + 4), {}}, c[2] = {load_four(start + 6), {}};
        for (std::int64_t k = 0; k < n; ++k) {
            const Four value = Four{z[k], z[k], z[k], z[k]};
            const float* row = rows + k * kOffsets;
            a[k % 2] += value * load_four(row);
            b[k % 2] += value * load_four(row + 4);
            c[k % 2] += value * load_four(row + 6);
        }
        float* to = out + g * kOffsets;
        store_four(to, a[0] + a[1]);
        store_four(to + 4, b[0] + b[1]);
        store_four(to + 6, c[0] + c[1]);
    }
}

}  // namespace
}  // namespace avatar::hyper
