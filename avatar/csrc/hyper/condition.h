#pragma once
// Conditioning on the latent. With d = z - mu_b, C = L21 and L = L11 of one head,
//
//     s = C^T d,   L^T x = s,   offset = mu_a - x,
//
// and for the cotangent g of the offset, with L w = -g:
//
//     grad mu_a = g,   grad C = d w^T,   grad L = -x w^T (lower part),   grad z = -grad mu_b = C w.
//
// The products with C stream through memory Gaussian by Gaussian, with the m values of an attribute in the lanes of a
// vector; the triangular systems are solved for kBlock Gaussians at once, one to a lane. Included only by kernels.cpp.
#include "hyper/exponential.h"
#include "hyper/four.h"
#include "hyper/kernels.h"

namespace avatar::hyper {
namespace {

constexpr int kBlock = 16;                // Gaussians whose triangular systems are solved together
enum class Latents { none, set, add };    // what becomes of their gradient: the first head sets it

// The triangular factors of up to kBlock Gaussians, transposed; lanes without a Gaussian hold the identity.
template <int M>
struct Factors {
    float below[M][M][kBlock];  // [i][j], i > j
    float inverse[M][kBlock];   // of the diagonal

    Factors(const float* lower, int count) {
        for (int i = 0; i < M; ++i) {
            for (int j = 0; j <= i; ++j) {
                float* to = i == j ? inverse[i] : below[i][j];
                for (int lane = 0; lane < count; ++lane) to[lane] = lower[lane * M * M + i * M + j];
                for (int lane = count; lane < kBlock; ++lane) to[lane] = 0;
            }
            for (int lane = 0; lane < kBlock; ++lane) inverse[i][lane] = exponential(-inverse[i][lane]);
        }
    }
};

// C^T (z - mu_b) of one Gaussian, in four partial sums.
template <int M>
inline Four pull(const float* cross, const float* mean_b, const float* z, std::int64_t n) {
    Four sums[4] = {};
    std::int64_t k = 0;
    for (; k + kStrip <= n; k += kStrip) {
        float d[kStrip];
        for (int j = 0; j < kStrip; ++j) d[j] = z[k + j] - mean_b[k + j];
        for (int j = 0; j < kStrip; ++j)
            sums[j % 4] += broadcast(d[j]) * load<M>(cross + (k + j) * M, j + 1 < kStrip || k + kStrip < n);
    }
    for (; k < n; ++k) sums[k % 4] += broadcast(z[k] - mean_b[k]) * load<M>(cross + k * M, k + 1 < n);
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

template <int M>
inline void forward_block(const Head& head, const float* latents, std::int64_t n, std::int64_t first, int count,
                          float* offsets, float* solved) {
    const std::int64_t size = M + n;
    float x[M][kBlock] = {};
    for (int lane = 0; lane < count; ++lane) {
        const std::int64_t g = first + lane;
        const Four sum = pull<M>(head.cross + g * n * M, head.mean + g * size + M, latents + g * n, n);
        for (int i = 0; i < M; ++i) x[i][lane] = sum[i];
    }
    const Factors<M> L(head.lower + first * M * M, count);
    for (int i = M - 1; i >= 0; --i) {
        for (int j = i + 1; j < M; ++j)
            for (int lane = 0; lane < kBlock; ++lane) x[i][lane] -= L.below[j][i][lane] * x[j][lane];
        for (int lane = 0; lane < kBlock; ++lane) x[i][lane] *= L.inverse[i][lane];
    }
    for (int lane = 0; lane < count; ++lane) {
        const std::int64_t g = first + lane;
        for (int i = 0; i < M; ++i) offsets[g * kOffsets + i] = head.mean[g * size + i] - x[i][lane];
        if (solved != nullptr)
            for (int i = 0; i < M; ++i) solved[g * kOffsets + i] = x[i][lane];
    }
}

void forward(const Head heads[kHeads], const float* latents, std::int64_t n, std::int64_t begin, std::int64_t end,
             float* offsets, float* solved) {
    const auto shifted = [](float* p, int by) { return p == nullptr ? nullptr : p + by; };
    for (std::int64_t first = begin; first < end; first += kBlock) {
        const int count = end - first < kBlock ? static_cast<int>(end - first) : kBlock;
        forward_block<3>(heads[0], latents, n, first, count, offsets, solved);
        forward_block<4>(heads[1], latents, n, first, count, offsets + 3, shifted(solved, 3));
        forward_block<3>(heads[2], latents, n, first, count, offsets + 7, shifted(solved, 7));
    }
}

// One Gaussian's C and what it meets, from the first latent dimension of a strip on.
struct Row {
    const float *cross, *mean_b, *z;
    float *grad_cross, *grad_mean_b, *grad_z;
};

// The gradients of kSize dimensions of C, mu_b and z; `last` if none follows.
template <int M, int kSize, bool kParameters, Latents kLatents>
inline void push(const Row& row, Four w, bool last) {
    float d[kSize], grad_d[kSize];
    for (int j = 0; j < kSize; ++j) d[j] = row.z[j] - row.mean_b[j];
    for (int j = 0; j < kSize; ++j) {
        const float* c = row.cross + j * M;
        grad_d[j] = c[0] * w[0] + c[1] * w[1] + c[2] * w[2];
        if constexpr (M == 4) grad_d[j] += c[3] * w[3];
    }
    if constexpr (kParameters) {
        for (int j = 0; j < kSize; ++j)
            store<M>(row.grad_cross + j * M, broadcast(d[j]) * w, j + 1 < kSize || !last);
        for (int j = 0; j < kSize; ++j) row.grad_mean_b[j] = -grad_d[j];
    }
    if constexpr (kLatents == Latents::set)
        for (int j = 0; j < kSize; ++j) row.grad_z[j] = grad_d[j];
    if constexpr (kLatents == Latents::add)
        for (int j = 0; j < kSize; ++j) row.grad_z[j] += grad_d[j];
}

template <int M, bool kParameters, Latents kLatents>
inline void backward_block(const Head& head, const float* latents, const float* solved, const float* grad_offsets,
                           std::int64_t n, std::int64_t first, int count, const HeadGradient& gradient,
                           float* grad_latents) {
    const std::int64_t size = M + n;
    const Factors<M> L(head.lower + first * M * M, count);
    float w[M][kBlock], residual[M][kBlock];  // residual = w times the diagonal
    for (int i = 0; i < M; ++i) {
        for (int lane = 0; lane < kBlock; ++lane)
            residual[i][lane] = lane < count ? -grad_offsets[(first + lane) * kOffsets + i] : 0;
        for (int j = 0; j < i; ++j)
            for (int lane = 0; lane < kBlock; ++lane) residual[i][lane] -= L.below[i][j][lane] * w[j][lane];
        for (int lane = 0; lane < kBlock; ++lane) w[i][lane] = residual[i][lane] * L.inverse[i][lane];
    }
    for (int lane = 0; lane < count; ++lane) {
        const std::int64_t g = first + lane;
        if constexpr (kParameters) {
            const float* x = solved + g * kOffsets;
            float* grad_lower = gradient.lower + g * M * M;
            for (int i = 0; i < M; ++i) {
                gradient.mean[g * size + i] = grad_offsets[g * kOffsets + i];
                for (int j = 0; j < i; ++j) grad_lower[i * M + j] = -x[i] * w[j][lane];
                grad_lower[i * M + i] = -x[i] * residual[i][lane];  // through exp
                for (int j = i + 1; j < M; ++j) grad_lower[i * M + j] = 0;
            }
        }
        Four own{};
        for (int i = 0; i < M; ++i) own[i] = w[i][lane];
        Row row{head.cross + g * n * M, head.mean + g * size + M, latents + g * n, nullptr, nullptr, nullptr};
        if constexpr (kParameters) {
            row.grad_cross = gradient.cross + g * n * M;
            row.grad_mean_b = gradient.mean + g * size + M;
        }
        if constexpr (kLatents != Latents::none) row.grad_z = grad_latents + g * n;
        const auto advance = [&](int by) {
            row.cross += by * M, row.mean_b += by, row.z += by;
            if constexpr (kParameters) row.grad_cross += by * M, row.grad_mean_b += by;
            if constexpr (kLatents != Latents::none) row.grad_z += by;
        };
        std::int64_t k = 0;
        for (; k + kStrip <= n; k += kStrip, advance(kStrip))
            push<M, kStrip, kParameters, kLatents>(row, own, k + kStrip == n);
        for (; k < n; ++k, advance(1)) push<M, 1, kParameters, kLatents>(row, own, k + 1 == n);
    }
}

template <bool kParameters, bool kLatents>
void backward_range(const Head heads[kHeads], const float* latents, const float* solved, const float* grad_offsets,
                    std::int64_t n, std::int64_t begin, std::int64_t end, const HeadGradient* gradients,
                    float* grad_latents) {
    constexpr Latents kFirst = kLatents ? Latents::set : Latents::none, kNext = kLatents ? Latents::add : Latents::none;
    const HeadGradient none{};
    const auto of = [&](int head) -> const HeadGradient& { return kParameters ? gradients[head] : none; };
    for (std::int64_t first = begin; first < end; first += kBlock) {
        const int count = end - first < kBlock ? static_cast<int>(end - first) : kBlock;
        backward_block<3, kParameters, kFirst>(heads[0], latents, solved, grad_offsets, n, first, count, of(0),
                                               grad_latents);
        backward_block<4, kParameters, kNext>(heads[1], latents, solved + 3, grad_offsets + 3, n, first, count, of(1),
                                              grad_latents);
        backward_block<3, kParameters, kNext>(heads[2], latents, solved + 7, grad_offsets + 7, n, first, count, of(2),
                                              grad_latents);
    }
}

void backward(const Head heads[kHeads], const float* latents, const float* solved, const float* grad_offsets,
              std::int64_t n, std::int64_t begin, std::int64_t end, const HeadGradient* gradients,
              float* grad_latents) {
    const auto range = gradients == nullptr      ? backward_range<false, true>
                       : grad_latents == nullptr ? backward_range<true, false>
                                                 : backward_range<true, true>;
    range(heads, latents, solved, grad_offsets, n, begin, end, gradients, grad_latents);
}

}  // namespace
}  // namespace avatar::hyper
