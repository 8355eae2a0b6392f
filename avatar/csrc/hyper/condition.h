#pragma once
// Conditioning on the latent. With d = z - mu_b, C = L21 and L = L11 of one head,
//
//     s = C^T d,   L^T x = s,   offset = mu_a - x,
//
// and for the cotangent g of the offset, with L w = -g:
//
//     grad mu_a = g,   grad C = d w^T,   grad L = -x w^T (lower part),   grad z = -grad mu_b = C w.
//
// A lane is a Gaussian. kBlock of them lie side by side in the parameters, so that all heads of a block are one stream of
// rows through memory, read and written without a shuffle; latents and offsets, which others use too, are transposed on
// the way. Included only by kernels.cpp.
#include "exponential.h"
#include "hyper/kernels.h"

namespace avatar::hyper {
namespace {

constexpr int kStrip = 16;  // latent dimensions that are transposed together
static_assert(kBlock % kLanes == 0);

// to[i][lane] = from[lane * stride + i] for i < size; 0 in lanes without a Gaussian.
inline void transpose_in(const float* from, std::int64_t stride, int count, int size, float (*to)[kBlock]) {
    for (int lane = 0; lane < count; ++lane)
        for (int i = 0; i < size; ++i) to[i][lane] = from[lane * stride + i];
    for (int lane = count; lane < kBlock; ++lane)
        for (int i = 0; i < size; ++i) to[i][lane] = 0;
}

inline void transpose_out(const float (*from)[kBlock], int count, int size, float* to, std::int64_t stride) {
    for (int lane = 0; lane < count; ++lane)
        for (int i = 0; i < size; ++i) to[lane * stride + i] = from[i][lane];
}

inline Floats row(const float* rows, int i) { return load_anywhere(rows + i * kBlock); }

// A gradient is not read again before others have pushed it out of the caches, so a whole line of it goes past them.
inline void set_row(float* rows, int i, Floats v) {
    if constexpr (kLanes == kBlock)
        store_past_caches(rows + i * kBlock, v);
    else
        store_anywhere(rows + i * kBlock, v);
}

// Reads rows in their order and drops them: the processor then takes them for a stream and fetches ahead at the rate of
// memory, which it does not for the order of the arithmetic.
inline void fetch(const float* rows, std::int64_t count) {
    constexpr int kAhead = 4096;  // floats; about two blocks at n = 8
    for (std::int64_t i = 0; i < count; ++i) {
        (void)*static_cast<const volatile float*>(rows + i * kBlock);
        __builtin_prefetch(rows + i * kBlock + kAhead, 0, 2);
    }
}

// Where the rows of position, rotation and scale begin: among the values, the triangles, and the rows of a dimension.
constexpr int kValues[kHeads] = {0, 3, 7}, kTriangles[kHeads] = {kOffsets, kOffsets + 6, kOffsets + 16};
constexpr int kDimensions[kHeads] = {0, 4, 9};

constexpr int lower_row(int i, int j) { return i * (i + 1) / 2 + j; }

// s += C^T d for one dimension of one head, whose rows are mu_b and C.
template <int M>
inline void pull(const float* rows, Floats z, Floats* s) {
    const Floats d = z - row(rows, 0);
    for (int i = 0; i < M; ++i) s[i] += row(rows, 1 + i) * d;
}

// x with L^T x = s, in place.
template <int M>
inline void solve_upper(const float* lower, Floats* s) {
    for (int i = M - 1; i >= 0; --i) {
        for (int j = i + 1; j < M; ++j) s[i] -= row(lower, lower_row(j, i)) * s[j];
        s[i] *= exponential_unfused(-row(lower, lower_row(i, i)));
    }
}

void forward(const float* parameters, const float* latents, std::int64_t gaussians, std::int64_t n, std::int64_t begin,
             std::int64_t end, float* offsets, float* solved) {
    for (std::int64_t block = begin; block < end; ++block) {
        const float* constants = parameters + block * rows_of(n) * kBlock;
        const float* dimensions = constants + kConstantRows * kBlock;
        const std::int64_t first = block * kBlock, left = gaussians - first;
        const int count = left < kBlock ? static_cast<int>(left) : kBlock;
        alignas(64) float z[kStrip][kBlock], x[kOffsets][kBlock] = {};
        fetch(constants, kConstantRows);
        for (std::int64_t k = 0; k < n; k += kStrip) {
            const int size = n - k < kStrip ? static_cast<int>(n - k) : kStrip;
            fetch(dimensions + k * kDimensionRows * kBlock, size * kDimensionRows);
            transpose_in(latents + first * n + k, n, count, size, z);
            for (int lane = 0; lane < kBlock; lane += kLanes) {
                Floats s[kOffsets];
                for (int i = 0; i < kOffsets; ++i) s[i] = load(x[i] + lane);
                for (int i = 0; i < size; ++i) {
                    const float* rows = dimensions + (k + i) * kDimensionRows * kBlock + lane;
                    const Floats value = load(z[i] + lane);
                    pull<3>(rows + kDimensions[0] * kBlock, value, s + kValues[0]);
                    pull<4>(rows + kDimensions[1] * kBlock, value, s + kValues[1]);
                    pull<3>(rows + kDimensions[2] * kBlock, value, s + kValues[2]);
                }
                for (int i = 0; i < kOffsets; ++i) store(x[i] + lane, s[i]);
            }
        }
        alignas(64) float out[kOffsets][kBlock];
        for (int lane = 0; lane < kBlock; lane += kLanes) {
            Floats s[kOffsets];
            for (int i = 0; i < kOffsets; ++i) s[i] = load(x[i] + lane);
            const float* rows = constants + lane;
            solve_upper<3>(rows + kTriangles[0] * kBlock, s + kValues[0]);
            solve_upper<4>(rows + kTriangles[1] * kBlock, s + kValues[1]);
            solve_upper<3>(rows + kTriangles[2] * kBlock, s + kValues[2]);
            for (int i = 0; i < kOffsets; ++i) {
                store(out[i] + lane, row(rows, i) - s[i]);
                if (solved != nullptr) store_anywhere(solved + (block * kOffsets + i) * kBlock + lane, s[i]);
            }
        }
        transpose_out(out, count, kOffsets, offsets + first * kOffsets, kOffsets);
    }
}

// w with L w = -g, in place, and the gradient of L if it is wanted.
template <int M, bool kParameters>
inline void solve_lower(const float* lower, const float* x, Floats* g, float* grad_lower) {
    for (int i = 0; i < M; ++i) {
        Floats residual = -g[i];  // w times the diagonal
        for (int j = 0; j < i; ++j) residual -= row(lower, lower_row(i, j)) * g[j];
        g[i] = residual * exponential_unfused(-row(lower, lower_row(i, i)));
        if constexpr (kParameters) {
            const Floats of_x = -row(x, i);
            for (int j = 0; j < i; ++j) set_row(grad_lower, lower_row(i, j), of_x * g[j]);
            set_row(grad_lower, lower_row(i, i), of_x * residual);  // through exp
        }
    }
}

// C w of one dimension of one head, and the gradients of its rows if they are wanted.
template <int M, bool kParameters>
inline Floats push(const float* rows, Floats z, const Floats* w, float* gradient) {
    Floats grad_d = row(rows, 1) * w[0];
    for (int i = 1; i < M; ++i) grad_d += row(rows, 1 + i) * w[i];
    if constexpr (kParameters) {
        const Floats d = z - row(rows, 0);
        set_row(gradient, 0, -grad_d);
        for (int i = 0; i < M; ++i) set_row(gradient, 1 + i, d * w[i]);
    }
    return grad_d;
}

template <bool kParameters, bool kLatents>
void backward_range(const float* parameters, const float* latents, const float* solved, const float* grad_offsets,
                    std::int64_t gaussians, std::int64_t n, std::int64_t begin, std::int64_t end, float* gradient,
                    float* grad_latents) {
    for (std::int64_t block = begin; block < end; ++block) {
        const std::int64_t start = block * rows_of(n) * kBlock, first = block * kBlock, left = gaussians - first;
        const int count = left < kBlock ? static_cast<int>(left) : kBlock;
        alignas(64) float w[kOffsets][kBlock], z[kStrip][kBlock], grad_z[kStrip][kBlock];
        fetch(parameters + start, kConstantRows);
        transpose_in(grad_offsets + first * kOffsets, kOffsets, count, kOffsets, w);
        for (int lane = 0; lane < kBlock; lane += kLanes) {
            const float *rows = parameters + start + lane, *x = solved + block * kOffsets * kBlock + lane;
            float* to = kParameters ? gradient + start + lane : nullptr;
            Floats g[kOffsets];
            for (int i = 0; i < kOffsets; ++i) {
                g[i] = load(w[i] + lane);
                if constexpr (kParameters) set_row(to, i, g[i]);
            }
            const auto solve = [&](auto solver, int head) {
                float* const to_triangle = kParameters ? to + kTriangles[head] * kBlock : nullptr;
                solver(rows + kTriangles[head] * kBlock, x + kValues[head] * kBlock, g + kValues[head], to_triangle);
            };
            solve(solve_lower<3, kParameters>, 0);
            solve(solve_lower<4, kParameters>, 1);
            solve(solve_lower<3, kParameters>, 2);
            for (int i = 0; i < kOffsets; ++i) store(w[i] + lane, g[i]);
        }
        for (std::int64_t k = 0; k < n; k += kStrip) {
            const int size = n - k < kStrip ? static_cast<int>(n - k) : kStrip;
            fetch(parameters + start + (kConstantRows + k * kDimensionRows) * kBlock, size * kDimensionRows);
            if constexpr (kParameters) transpose_in(latents + first * n + k, n, count, size, z);
            for (int lane = 0; lane < kBlock; lane += kLanes) {
                Floats v[kOffsets];
                for (int i = 0; i < kOffsets; ++i) v[i] = load(w[i] + lane);
                for (int i = 0; i < size; ++i) {
                    const std::int64_t at = start + (kConstantRows + (k + i) * kDimensionRows) * kBlock + lane;
                    const float* rows = parameters + at;
                    const Floats value = kParameters ? load(z[i] + lane) : Floats{};
                    const auto of = [&](auto pusher, int head) {
                        float* const to = kParameters ? gradient + at + kDimensions[head] * kBlock : nullptr;
                        return pusher(rows + kDimensions[head] * kBlock, value, v + kValues[head], to);
                    };
                    Floats sum = of(push<3, kParameters>, 0);
                    sum += of(push<4, kParameters>, 1);
                    sum += of(push<3, kParameters>, 2);
                    if constexpr (kLatents) store(grad_z[i] + lane, sum);
                }
            }
            if constexpr (kLatents) transpose_out(grad_z, count, size, grad_latents + first * n + k, n);
        }
    }
}

void backward(const float* parameters, const float* latents, const float* solved, const float* grad_offsets,
              std::int64_t gaussians, std::int64_t n, std::int64_t begin, std::int64_t end, float* gradient,
              float* grad_latents) {
    const auto range = gradient == nullptr       ? backward_range<false, true>
                       : grad_latents == nullptr ? backward_range<true, false>
                                                 : backward_range<true, true>;
    range(parameters, latents, solved, grad_offsets, gaussians, n, begin, end, gradient, grad_latents);
    finish_stores_past_caches();
}

}  // namespace
}  // namespace avatar::hyper
