#pragma once
#include <cstdint>

// From raw offsets and per-Gaussian parameters to what is splatted, and back, without Python: the formulas are those of
// avatar/gaussians/apply_offsets.py.
namespace avatar::apply_offsets {

// Of N Gaussians; arrays as in apply_offsets_cpu.py, `raw` [N, 10] before the tanh.
struct Parameters {
    const float *points, *quats, *log_scales, *opacity_logits, *raw;
};

struct Activated {
    float *means, *quats, *scales, *opacities;
};

// The derivatives of a scalar by what is activated, and activated values that shorten the way back.
struct Upstream {
    const float *means, *quats, *scales, *opacities;
    const float *activated_scales, *activated_opacities;
};

// By the parameters. The gradient of the points is that of the means.
struct Gradients {
    float *quats, *log_scales, *opacity_logits, *raw;
};

// Both work on Gaussians [begin, end) and write nothing else.
struct Kernels {
    void (*forward)(const Parameters&, std::int64_t begin, std::int64_t end, const Activated&);
    void (*backward)(const Parameters&, const Upstream&, std::int64_t begin, std::int64_t end, const Gradients&);
};

// As avatar::choose_instruction_set.
const Kernels& select_kernels(const char* name);

}  // namespace avatar::apply_offsets
