#pragma once
#include <cstddef>

// Structural dissimilarity of two masked images with its gradient, without Python: what
// avatar/losses/dssim_cpu.py documents.
//
// With u = x + y and v = x - y, and m and s for mean and variance over a window,
//     SSIM = (1 - a) (1 - b),   a = m_v^2 / ((m_u^2 + m_v^2) / 2 + C1),   b = s_v / ((s_u + s_v) / 2 + C2),
// which is the formula of Wang et al. 2004 in four filtered images in place of five, and 1 - SSIM = a + b - a b has no
// difference of nearly equal numbers where the images agree.
namespace avatar::ssim {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1, kChannels = 3;
constexpr int kReach = 2 * kRadius * kChannels;  // from a window's first value to its last in a row
constexpr int kMaxDoubles = 8;                   // rows are padded so that a kernel may read and write whole vectors
constexpr int kPadding = kReach + 2 * kMaxDoubles;

// What slides down the frame: the last kTaps rows of pixels and of windows, row y in place y % kTaps. A row holds `values`
// doubles, three a pixel, and `stride` may be read and written.
struct Rows {
    int values;
    std::ptrdiff_t stride;
    double *sum, *difference;  // [kTaps, stride] u and v, times the mask
    // [kTaps, 3, stride] derivatives of the windows' 1 - SSIM by the windows' moments, spread along the row: those that
    // multiply 1, u and v.
    double* coefficients;
    double* scratch;  // [7, stride + kPadding], zero when it is new
};

struct Kernels {
    // The sum of 1 - SSIM over the windows whose first row is `row`; also their coefficients, if asked for.
    double (*window_row)(const Rows& rows, int row, bool with_coefficients);

    // The derivative of the sum of all 1 - SSIM by x in row `row`, [stride]. The windows that read the row are those of
    // which `first` to `last` are the first rows.
    void (*gradient_row)(const Rows& rows, int row, int first, int last, double* gradient);
};

// As avatar::choose_instruction_set.
const Kernels& select_kernels(const char* name);

struct Images {
    const float *image, *target;  // [height, width, 3]
    const float* mask;            // [height, width]
    int height, width;            // at least kTaps
};

// (1 - SSIM) / 2 of image * mask against target * mask, the mean over all windows of the frame and channels; its
// gradient [height, width, 3] by `image` if `gradient` is not null. In double precision, because a variance is a
// difference; the result does not depend on the number of threads.
double dssim(const Images& images, const Kernels& kernels, int threads, float* gradient);

}  // namespace avatar::ssim
