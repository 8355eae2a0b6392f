#pragma once
#include <cstdint>

// From raw offsets and per-Gaussian parameters to what is splatted, and back, without Python: the formulas are those of
// avatar/gaussians/apply_offsets.py.
namespace avatar::compose {

// Of N Gaussians; arrays as in compose.py, `raw` [N, 10] before the tanh.
struct Parameters {
    const float *points, *quats, *log_scales, *opacity_logits, *raw;
};

struct Composed {
    float *means, *quats, *scales, *opacities;
};

// The derivatives of a scalar by what was composed, and what was composed where it shortens the way back.
struct Upstream {
    const float *means, *quats, *scales, *opacities;
    const float *composed_scales, *composed_opacities;
};

// By the parameters. The gradient of the points is that of the means.
struct Gradients {
    float *quats, *log_scales, *opacity_logits, *raw;
};

// Both work on Gaussians [begin, end) and write nothing else.
struct Kernels {
    void (*forward)(const Parameters&, std::int64_t begin, std::int64_t end, const Composed&);
    void (*backward)(const Parameters&, const Upstream&, std::int64_t begin, std::int64_t end, const Gradients&);
};

// As avatar::choose_instruction_set.
const Kernels& select_kernels(const char* name);

}  // namespace avatar::compose
