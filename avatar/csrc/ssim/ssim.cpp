#include "ssim/ssim.h"

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "instruction_set.h"
#include "thread_pool.h"

namespace avatar::ssim {

extern const Kernels kernels_baseline;
#ifdef AVATAR_X86_KERNELS
extern const Kernels kernels_avx2;
extern const Kernels kernels_avx512;
#endif

const Kernels& select_kernels(const char* name) {
    switch (choose_instruction_set(name)) {
#ifdef AVATAR_X86_KERNELS
        case InstructionSet::avx512:
            return kernels_avx512;
        case InstructionSet::avx2:
            return kernels_avx2;
#endif
        default:
            return kernels_baseline;
    }
}

namespace {

constexpr std::int64_t kGrain = 8;  // rows handed to a thread at a time

struct Box {
    int left, top, right, bottom;  // right and bottom not included
    bool empty() const { return left >= right; }
};

Box bounding_box(const Images& images) {
    std::vector<unsigned char> used(images.width);
    Box box{0, images.height, 0, 0};
    for (int y = 0; y < images.height; ++y) {
        const float* row = images.mask + std::int64_t{y} * images.width;
        unsigned char any = 0;
        for (int x = 0; x < images.width; ++x) {
            const unsigned char set = row[x] != 0.0f;
            used[x] |= set;
            any |= set;
        }
        if (any != 0) {
            box.top = std::min(box.top, y);
            box.bottom = y + 1;
        }
    }
    const auto is_set = [](unsigned char set) { return set != 0; };
    box.left = static_cast<int>(std::find_if(used.begin(), used.end(), is_set) - used.begin());
    box.right = static_cast<int>(used.rend() - std::find_if(used.rbegin(), used.rend(), is_set));
    return box;
}

// The pixels that windows touching the mask read. The other windows see two black images and add nothing.
Box windows_box(const Images& images) {
    const Box box = bounding_box(images);
    if (box.empty()) return box;
    return {std::max(box.left - 2 * kRadius, 0), std::max(box.top - 2 * kRadius, 0),
            std::min(box.right + 2 * kRadius, images.width), std::min(box.bottom + 2 * kRadius, images.height)};
}

}  // namespace

double dssim(const Images& images, const Kernels& kernels, int threads, float* gradient) {
    const Box box = windows_box(images);
    const std::int64_t width = images.width;
    if (box.empty()) {
        if (gradient != nullptr) std::fill_n(gradient, images.height * width * kChannels, 0.0f);
        return 0.0;
    }
    const int height = box.bottom - box.top, windows = height - 2 * kRadius;
    const int values = (box.right - box.left) * kChannels;
    const std::ptrdiff_t stride = values + kPadding;

    const std::unique_ptr<double[]> sum(new double[height * stride]), difference(new double[height * stride]);
    const Rows rows{sum.get(), difference.get(), values, stride};
    parallel_for(threads, height, kGrain, [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t y = begin; y < end; ++y) {
            const std::int64_t first = (box.top + y) * width + box.left;
            const float *x = images.image + first * kChannels, *t = images.target + first * kChannels;
            double *u = sum.get() + y * stride, *v = difference.get() + y * stride;
            for (int i = 0; i < values; ++i) {
                const double weight = images.mask[first + i / kChannels];
                u[i] = (double{x[i]} + double{t[i]}) * weight;
                v[i] = (double{x[i]} - double{t[i]}) * weight;
            }
            std::fill(u + values, u + stride, 0.0);
            std::fill(v + values, v + stride, 0.0);
        }
    });

    std::vector<double> row_sums(windows);
    const std::unique_ptr<double[]> coefficients(gradient == nullptr ? nullptr : new double[windows * 3 * stride]);
    parallel_for(threads, windows, kGrain, [&](std::int64_t begin, std::int64_t end) {
        std::vector<double> scratch(7 * (stride + kPadding));
        for (std::int64_t y = begin; y < end; ++y)
            row_sums[y] = kernels.window_row(rows, static_cast<int>(y), scratch.data(),
                                             coefficients ? coefficients.get() + y * 3 * stride : nullptr);
    });
    double total = 0;
    for (const double row_sum : row_sums) total += row_sum;
    const double all_windows = double(images.height - 2 * kRadius) * double(images.width - 2 * kRadius);
    const double scale = 1.0 / (2.0 * kChannels * all_windows);
    if (gradient == nullptr) return total * scale;

    parallel_for(threads, images.height, kGrain, [&](std::int64_t begin, std::int64_t end) {
        std::vector<double> by_masked(stride);
        for (std::int64_t y = begin; y < end; ++y) {
            float* row = gradient + y * width * kChannels;
            std::fill_n(row, width * kChannels, 0.0f);
            if (y < box.top || y >= box.bottom) continue;
            kernels.gradient_row(rows, static_cast<int>(y) - box.top, coefficients.get(), windows, by_masked.data());
            const float* mask = images.mask + y * width + box.left;
            for (int i = 0; i < values; ++i)
                row[box.left * kChannels + i] = static_cast<float>(by_masked[i] * mask[i / kChannels] * scale);
        }
    });
    return total * scale;
}

}  // namespace avatar::ssim
