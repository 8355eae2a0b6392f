#include "ssim/ssim.h"

#include <algorithm>
#include <cstdint>
#include <vector>

#include "dispatch.h"
#include "thread_pool.h"

namespace avatar::ssim {

AVATAR_DEFINE_SELECT_KERNELS

namespace {

// A thread gets at least so many rows at a time; it computes the kTaps - 1 rows of windows above them once more.
constexpr int kMinRows = 32;

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

// The work on one box, from its top down; rows count from there.
struct Slide {
    const Images& images;
    const Kernels& kernels;
    Box box;
    double scale;     // of the gradient
    float* gradient;  // of the whole frame, may be null

    int values() const { return (box.right - box.left) * kChannels; }
    int height() const { return box.bottom - box.top; }
    int windows() const { return height() - 2 * kRadius; }

    // The sums of the windows whose first rows are [begin, end), and the gradient of these rows.
    void run(int begin, int end, double* row_sums) const {
        const std::ptrdiff_t stride = values() + kPadding, part = kTaps * stride;
        std::vector<double> memory(5 * part + 7 * (stride + kPadding)), by_masked(stride);
        double* const start = memory.data();
        const Rows rows{values(), stride, start, start + part, start + 2 * part, start + 5 * part};
        const int above = gradient == nullptr ? begin : std::max(begin - kTaps + 1, 0);
        int read = above;
        for (int row = above; row < end; ++row) {
            if (row < windows()) {
                while (read < row + kTaps) read_row(rows, read++);
                const double sum = kernels.window_row(rows, row, gradient != nullptr);
                if (row >= begin) row_sums[row] = sum;
            }
            if (gradient == nullptr || row < begin) continue;
            const int first = std::max(row - kTaps + 1, 0), last = std::min(row, windows() - 1);
            kernels.gradient_row(rows, row, first, last, by_masked.data());
            write_row(by_masked, row);
        }
    }

    void read_row(const Rows& rows, int row) const {
        const std::int64_t first = std::int64_t{box.top + row} * images.width + box.left;
        const float *x = images.image + first * kChannels, *t = images.target + first * kChannels;
        double *u = rows.sum + row % kTaps * rows.stride, *v = rows.difference + row % kTaps * rows.stride;
        for (int i = 0; i < rows.values; i += kChannels) {
            const double weight = images.mask[first + i / kChannels];
            for (int c = i; c < i + kChannels; ++c) {
                u[c] = (double{x[c]} + double{t[c]}) * weight;
                v[c] = (double{x[c]} - double{t[c]}) * weight;
            }
        }
    }

    void write_row(const std::vector<double>& by_masked, int row) const {
        const std::int64_t first = std::int64_t{box.top + row} * images.width + box.left;
        float* to = gradient + first * kChannels;
        for (int i = 0; i < values(); i += kChannels) {
            const double weight = images.mask[first + i / kChannels] * scale;
            for (int c = i; c < i + kChannels; ++c) to[c] = static_cast<float>(by_masked[c] * weight);
        }
    }
};

}  // namespace

double dssim(const Images& images, const Kernels& kernels, int threads, float* gradient) {
    if (gradient != nullptr) std::fill_n(gradient, std::int64_t{images.height} * images.width * kChannels, 0.0f);
    const Box box = windows_box(images);
    if (box.empty()) return 0.0;
    const double all_windows = double(images.height - 2 * kRadius) * double(images.width - 2 * kRadius);
    const Slide slide{images, kernels, box, 1.0 / (2.0 * kChannels * all_windows), gradient};
    std::vector<double> row_sums(slide.windows());
    const int count = gradient == nullptr ? slide.windows() : slide.height();
    const int grain = std::max(kMinRows, (count + 2 * threads - 1) / (2 * threads));  // two for each thread, if one is late
    parallel_for(threads, count, grain, [&](std::int64_t begin, std::int64_t end) {
        slide.run(static_cast<int>(begin), static_cast<int>(end), row_sums.data());
    });
    double total = 0;
    for (const double row_sum : row_sums) total += row_sum;
    return total * slide.scale;
}

}  // namespace avatar::ssim
