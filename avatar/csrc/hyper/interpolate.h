#pragma once
// Included only by kernels.cpp, as is all that has internal linkage here.
#include "hyper/kernels.h"

namespace avatar::hyper {
namespace {

constexpr int kSummed = 8;  // latent dimensions that are summed together

void interpolate(const Corners& corners, const float* grid, std::int64_t n, std::int64_t begin, std::int64_t end,
                 float* out) {
    for (std::int64_t g = begin; g < end; ++g) {
        const std::int32_t* cells = corners.cells + 4 * g;
        const float* w = corners.weights + 4 * g;
        const float *a = grid + cells[0] * n, *b = grid + cells[1] * n, *c = grid + cells[2] * n,
                    *d = grid + cells[3] * n;
        float* __restrict__ row = out + g * n;
        for (std::int64_t k = 0; k < n; ++k) row[k] = w[0] * a[k] + w[1] * b[k] + w[2] * c[k] + w[3] * d[k];
    }
}

void interpolate_backward(const Touching& touching, const float* grad, std::int64_t n, std::int64_t begin,
                          std::int64_t end, float* grad_grid) {
    for (std::int64_t cell = begin; cell < end; ++cell) {
        const std::int64_t first = touching.begin[cell], last = touching.begin[cell + 1];
        float* __restrict__ row = grad_grid + cell * n;
        std::int64_t k = 0;
        for (; k + kSummed <= n; k += kSummed) {
            float sums[kSummed] = {};  // in registers
            for (std::int64_t i = first; i < last; ++i) {
                const float weight = touching.weights[i];
                const float* from = grad + touching.gaussians[i] * n + k;
                for (int j = 0; j < kSummed; ++j) sums[j] += weight * from[j];
            }
            for (int j = 0; j < kSummed; ++j) row[k + j] = sums[j];
        }
        for (; k < n; ++k) {
            float sum = 0;
            for (std::int64_t i = first; i < last; ++i) sum += touching.weights[i] * grad[touching.gaussians[i] * n + k];
            row[k] = sum;
        }
    }
}

}  // namespace
}  // namespace avatar::hyper
