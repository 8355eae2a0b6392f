#pragma once
#include <cstdint>

// The loops over Gaussians, compiled for several instruction sets and chosen when the program runs. Every kernel does the
// range [begin, end) of its first argument's rows and writes nothing else, so any split over threads gives the same bits.
namespace avatar::hyper {

// Rows of n values at the nodes of a grid, and for each Gaussian the four nodes that it lies between.
struct Corners {
    const std::int32_t* cells;  // [gaussians * 4]
    const float* weights;       // [gaussians * 4]
};

// The same pairs by node: those of node c are begin[c] .. begin[c + 1], in the order of the Gaussians.
struct Touching {
    const std::int64_t* begin;      // [nodes + 1]
    const std::int32_t* gaussians;  // [gaussians * 4]
    const float* weights;           // [gaussians * 4]
};

// The heads of position, rotation and scale, with 3, 4 and 3 values. Their parameters are [blocks, rows_of(n), kBlock]: a
// block holds kBlock Gaussians side by side, the last one zeros beyond the last Gaussian. avatar/gaussians/hyper.py says
// what the rows are.
constexpr int kBlock = 16, kHeads = 3, kOffsets = 3 + 4 + 3;
constexpr int kConstantRows = kOffsets + 6 + 10 + 6;  // the mean of the attributes, the triangular factors
constexpr int kDimensionRows = 3 + kOffsets;          // for each head the mean of the latent and a row of the cross term

constexpr std::int64_t rows_of(std::int64_t n) { return kConstantRows + n * kDimensionRows; }

struct Kernels {
    // For the blocks begin .. end: offsets [gaussians, 10] from latents [gaussians, n]; solved [blocks, 10, kBlock], which
    // may be null, is what the backward pass needs of them: the means of the attributes minus the offsets.
    void (*forward)(const float* parameters, const float* latents, std::int64_t gaussians, std::int64_t n,
                    std::int64_t begin, std::int64_t end, float* offsets, float* solved);
    // Every value of `gradient`, as large as the parameters and aligned to 64 bytes, and of grad_latents [gaussians, n] is
    // written; one of them may be null.
    void (*backward)(const float* parameters, const float* latents, const float* solved, const float* grad_offsets,
                     std::int64_t gaussians, std::int64_t n, std::int64_t begin, std::int64_t end, float* gradient,
                     float* grad_latents);
    // out [gaussians, 10] = bias [gaussians, 10] + latents [gaussians, n] times matrix [gaussians, n, 10]
    void (*apply)(const float* matrix, const float* bias, const float* latents, std::int64_t n, std::int64_t begin,
                  std::int64_t end, float* out);
    // out [gaussians, n] = the weighted sum of four rows of grid [nodes, n]
    void (*interpolate)(const Corners&, const float* grid, std::int64_t n, std::int64_t begin, std::int64_t end,
                        float* out);
    // grad_grid [nodes, n] from grad [gaussians, n]
    void (*interpolate_backward)(const Touching&, const float* grad, std::int64_t n, std::int64_t begin,
                                 std::int64_t end, float* grad_grid);
};

// The kernels for a name that choose_instruction_set() takes.
const Kernels& select_kernels(const char* name);

}  // namespace avatar::hyper
