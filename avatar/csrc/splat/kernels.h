#pragma once
#include "splat/project.h"
#include "splat/raster.h"

// The loops over Gaussians and pixels, compiled for several instruction sets and chosen when the program runs. Every
// kernel does a range of Gaussians, or a tile, and writes nothing else, so any split over threads gives the same bits.
namespace avatar::splat {

struct Kernels {
    int words;  // in a set of a tile's blocks, which have as many pixels as a vector has lanes
    bool (*all_finite)(const float* values, std::int64_t count);
    void (*project)(const View&, const Gaussians&, std::int64_t begin, std::int64_t end, const Projection&);
    // Writes (does not add) the gradients of Gaussians begin .. end - 1 from moments [pairs * kMoments], by slot, and to
    // grad_pose [kPoseValues], unless that is null, what they add to the gradient of the camera's pose.
    void (*project_backward)(const View&, const Gaussians&, std::int64_t begin, std::int64_t end,
                             const std::uint32_t* slot_begin, const float* moments, const GaussianGradients&,
                             double* grad_pose);
    void (*forward_tile)(const Raster&, std::int64_t tile, const ForwardTarget&);
    void (*backward_tile)(const Raster&, std::int64_t tile, const BackwardSource&, const BackwardTarget&);

    // The same with features in place of colours. Both tiles need a workspace of so many floats, for one call.
    void (*project_backward_features)(const View&, const Gaussians&, std::int64_t begin, std::int64_t end,
                                      const std::uint32_t* slot_begin, const float* moments, const GaussianGradients&,
                                      double* grad_pose);
    std::int64_t (*feature_workspace)(int channels);
    void (*forward_features)(const Raster&, const FeatureChannels&, std::int64_t tile, const ForwardTarget&,
                             float* workspace);
    void (*backward_features)(const Raster&, const FeatureChannels&, std::int64_t tile, const BackwardSource&,
                              const BackwardTarget&, float* workspace);
};

// The kernels for a name that choose_instruction_set() takes.
const Kernels& select_kernels(const char* name);

}  // namespace avatar::splat
