#pragma once
// The folded heads: one affine map of the latent for each Gaussian. Included only by kernels.cpp.
#include "hyper/four.h"
#include "hyper/kernels.h"

namespace avatar::hyper {
namespace {

void apply(const float* matrix, const float* bias, const float* latents, std::int64_t n, std::int64_t begin,
           std::int64_t end, float* out) {
    for (std::int64_t g = begin; g < end; ++g) {
        const float *rows = matrix + g * n * kOffsets, *z = latents + g * n, *start = bias + g * kOffsets;
        // Values 0-3, 4-7 and 6-9: an overlap is cheaper than a rest.
        Four a[2] = {load<4>(start, true), {}}, b[2] = {load<4>(start + 4, true), {}}, c[2] = {load<4>(start + 6, true), {}};
        for (std::int64_t k = 0; k < n; ++k) {
            const Four value = broadcast(z[k]);
            const float* row = rows + k * kOffsets;
            a[k % 2] += value * load<4>(row, true);
            b[k % 2] += value * load<4>(row + 4, true);
            c[k % 2] += value * load<4>(row + 6, true);
        }
        float* to = out + g * kOffsets;
        store<4>(to, a[0] + a[1], true);
        store<4>(to + 4, b[0] + b[1], true);
        store<4>(to + 6, c[0] + c[1], true);
    }
}

}  // namespace
}  // namespace avatar::hyper
