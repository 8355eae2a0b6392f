#pragma once
#include <memory>
#include <vector>

#include "splat/bin.h"
#include "splat/kernels.h"
#include "splat/scene.h"

// The whole splatter without Python: what avatar/splat/__init__.py documents, in two calls.
namespace avatar::splat {

// What one drawing did and what it skipped.
struct Counts {
    std::int64_t hidden[4];          // Gaussians by the reason: transparent, near, flat, outside
    std::int64_t visible;            // Gaussians
    std::int64_t without_effect;     // visible ones that no pixel shows
    std::int64_t tiles, tiles_stopped;
    std::int64_t blocks, blocks_stopped;  // of as many pixels as a vector has lanes; stopped: all pixels saturated
    std::int64_t pairs;              // of a tile and a splat
    std::int64_t pairs_in_boxes;     // as many as the boxes around the ellipses would meet
    std::int64_t pairs_in_squares;   // as many as squares of 3 standard deviations of the longer axis would meet
    std::int64_t pairs_processed;    // before their tile stopped
    std::int64_t pixels_evaluated, pixels_composited;  // of all pairs
};

// What the backward pass needs of a forward pass. Not changed after that, so it may be used from several threads.
struct Drawing {
    View view;
    float background[3];
    const Kernels* kernels;
    int threads;
    std::unique_ptr<Splat[]> splats;  // [N], written where the Gaussian is visible
    TileLists lists;
    std::unique_ptr<float[]> ends;  // this and the next: see ForwardTarget
    std::unique_ptr<Word[]> blocks;
};

// Draws the region into image [height * width * 3] and alpha [height * width]; the rest of them shows the background.
// Null when an input is not finite. Throws std::invalid_argument for a colour that overflows, std::length_error for too
// many pairs of tile and splat. Fills `counts` if it is given, which takes longer.
std::unique_ptr<Drawing> forward(const Gaussians& gaussians, const Camera& camera, const Settings& settings,
                                 const Region& region, const float background[3], const Kernels& kernels, int threads,
                                 float* image, float* alpha, Counts* counts = nullptr);

// Writes all gradients. grad_image or grad_alpha may be null, and grad_pose [kPoseValues] where it is not wanted.
void backward(const Drawing& drawing, const Gaussians& gaussians, const float* grad_image, const float* grad_alpha,
              const GaussianGradients& gradients, float grad_background[3], double* grad_pose);

}  // namespace avatar::splat
