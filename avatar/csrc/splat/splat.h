#pragma once
#include <memory>
#include <vector>

#include "splat/bin.h"
#include "splat/kernels.h"
#include "splat/scene.h"

// The whole splatter without Python: what avatar/splat/__init__.py documents, in two calls.
namespace avatar::splat {

// What the backward pass needs of a forward pass. Not changed after that, so it may be used from several threads.
struct Drawing {
    View view;
    std::vector<float> background;  // of each channel
    const Kernels* kernels;
    int threads;
    std::unique_ptr<Splat[]> splats;  // [N], written where the Gaussian is visible
    TileLists lists;
    std::unique_ptr<float[]> ends;  // this and the next: see ForwardTarget
    std::unique_ptr<Word[]> blocks;
};

// Draws the region into image [height * width * channels] and alpha [height * width]; the rest of them shows the
// background. There are as many channels as the Gaussians have features, or three. Null when an input is not finite.
// Throws std::invalid_argument for a colour that overflows, std::length_error for too many pairs of tile and splat.
std::unique_ptr<Drawing> forward(const Gaussians& gaussians, const Camera& camera, const Settings& settings,
                                 const Region& region, const float* background, const Kernels& kernels, int threads,
                                 float* image, float* alpha);

// Writes all gradients of a drawing of the same Gaussians. grad_image or grad_alpha may be null, and grad_pose
// [kPoseValues] where it is not wanted.
void backward(const Drawing& drawing, const Gaussians& gaussians, const float* grad_image, const float* grad_alpha,
              const GaussianGradients& gradients, float* grad_background, double* grad_pose);

}  // namespace avatar::splat
