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

struct Kernels {
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
