// Compiled once for each instruction set; AVATAR_KERNELS says which. Products and sums may be fused here: nothing has to
// round like anything else.
#include "simd.h"
#include "ssim/ssim.h"

namespace avatar::ssim {
namespace {

static_assert(kDoubles <= kMaxDoubles);

constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;

// exp(-k^2 / (2 sigma^2)) with sigma = 1.5, divided by their sum.
constexpr double kGaussian[kTaps] = {
    0.00102838008447911, 0.007598758135239185, 0.03600077212843083,  0.10936068950970002,
    0.2130055377112537,  0.26601172486179436,  0.2130055377112537,   0.10936068950970002,
    0.03600077212843083, 0.007598758135239185, 0.00102838008447911};

double window_row(const Rows& rows, int row, bool with_coefficients) {
    const std::ptrdiff_t stride = rows.stride, part = stride + kPadding;
    const int values = rows.values, windows = values - kReach;
    double *mean_u = rows.scratch, *mean_v = mean_u + part, *square_u = mean_v + part, *square_v = square_u + part;
    double *by_one = square_v + part, *by_u = by_one + part, *by_v = by_u + part;

    const double *us[kTaps], *vs[kTaps];
    for (int k = 0; k < kTaps; ++k) {
        us[k] = rows.sum + (row + k) % kTaps * stride;
        vs[k] = rows.difference + (row + k) % kTaps * stride;
    }
    for (int i = 0; i < values; i += kDoubles) {
        Doubles mu{}, mv{}, uu{}, vv{};
        for (int k = 0; k < kTaps; ++k) {
            const Doubles u = load_anywhere(us[k] + i), v = load_anywhere(vs[k] + i);
            const Doubles gu = kGaussian[k] * u, gv = kGaussian[k] * v;
            mu += gu;
            mv += gv;
            uu += gu * u;
            vv += gv * v;
        }
        store_anywhere(mean_u + i, mu);
        store_anywhere(mean_v + i, mv);
        store_anywhere(square_u + i, uu);
        store_anywhere(square_v + i, vv);
    }

    Doubles total{};
    double rest = 0;
    for (int i = 0; i < windows; i += kDoubles) {
        Doubles mu{}, mv{}, uu{}, vv{};
        for (int k = 0; k < kTaps; ++k) {
            const int at = i + kChannels * k;
            mu += kGaussian[k] * load_anywhere(mean_u + at);
            mv += kGaussian[k] * load_anywhere(mean_v + at);
            uu += kGaussian[k] * load_anywhere(square_u + at);
            vv += kGaussian[k] * load_anywhere(square_v + at);
        }
        const Doubles variance_u = uu - mu * mu, variance_v = vv - mv * mv;
        const Doubles p = 1.0 / (0.5 * (mu * mu + mv * mv) + kC1), q = 1.0 / (0.5 * (variance_u + variance_v) + kC2);
        const Doubles a = mv * mv * p, b = variance_v * q;
        const Doubles dissimilarity = a + b - a * b;
        if (i + kDoubles <= windows)
            total += dissimilarity;
        else
            for (int lane = 0; lane < windows - i; ++lane) rest += dissimilarity[lane];
        if (!with_coefficients) continue;
        // By the means at fixed mean squares, and by the mean squares; m_u and m_v have the same derivative by x.
        const Doubles by_uu = (a - 1.0) * b * q, by_vv = (1.0 - a) * (2.0 - b) * q;
        store_anywhere(by_u + kReach + i, by_uu);
        store_anywhere(by_v + kReach + i, by_vv);
        store_anywhere(by_one + kReach + i, ((2.0 - a) * mv - a * mu) * (1.0 - b) * p - by_uu * mu - by_vv * mv);
    }
    for (int lane = 0; lane < kDoubles; ++lane) rest += total[lane];
    if (!with_coefficients) return rest;

    double* const sources[3] = {by_one, by_u, by_v};
    double* coefficients = rows.coefficients + row % kTaps * 3 * stride;
    for (int c = 0; c < 3; ++c) {
        // Windows beyond the last one are not: the vectors may have reached over the end.
        for (int i = 0; i < kReach + kDoubles; ++i) sources[c][kReach + windows + i] = 0.0;
        for (int i = 0; i < values; i += kDoubles) {
            Doubles sum{};
            for (int k = 0; k < kTaps; ++k) sum += kGaussian[k] * load_anywhere(sources[c] + i + kChannels * k);
            store_anywhere(coefficients + c * stride + i, sum);
        }
    }
    return rest;
}

void gradient_row(const Rows& rows, int row, int first, int last, double* gradient) {
    const std::ptrdiff_t stride = rows.stride;
    const int values = rows.values, count = last - first + 1;
    const double *us = rows.sum + row % kTaps * stride, *vs = rows.difference + row % kTaps * stride;
    const double *sources[kTaps], *weights = kGaussian + row - last;
    for (int k = 0; k < count; ++k) sources[k] = rows.coefficients + (last - k) % kTaps * 3 * stride;
    for (int i = 0; i < values; i += kDoubles) {
        Doubles by_one{}, by_u{}, by_v{};
        for (int k = 0; k < count; ++k) {
            const double* source = sources[k] + i;
            by_one += weights[k] * load_anywhere(source);
            by_u += weights[k] * load_anywhere(source + stride);
            by_v += weights[k] * load_anywhere(source + 2 * stride);
        }
        store_anywhere(gradient + i, by_one + load_anywhere(us + i) * by_u + load_anywhere(vs + i) * by_v);
    }
}

}  // namespace

extern const Kernels AVATAR_KERNELS;
const Kernels AVATAR_KERNELS = {window_row, gradient_row};

}  // namespace avatar::ssim
