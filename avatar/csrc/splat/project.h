#pragma once
#include "splat/scene.h"

// Gaussian -> Splat and its derivative: pinhole projection of mean and covariance (Zwicker et al. 2002), colour from
// spherical harmonics. The geometry is in double: scales of 1e-12 and of 1e6 in one scene must give neither zeros nor
// NaN.
namespace avatar::splat {

// What is the same for all Gaussians of one call.
struct View {
    View(const Camera& camera, const Settings& settings, const Region& region);

    Camera camera;
    Settings settings;
    Region region;
    double centre[3];               // of the camera, world
    double slope_x[2], slope_y[2];  // range to which x / z and y / z are clamped in the Jacobian
};

// Why a Gaussian is not drawn, or that it is.
enum class Visibility { kVisible, kTransparent, kNear, kFlat, kOutside, kColourOverflow };

// Fills `splat` (all but `index`) and the depth of the centre. Hidden, in the order of the enumeration: opacity below
// alpha_min, nearer than `near`, no area on the image plane, no pixel of the region where alpha can reach alpha_min.
Visibility project(const View& view, const Gaussians& gaussians, std::int64_t i, Splat& splat, double& depth);

// Writes (does not add) the gradients of Gaussian i, from the moments of its splat summed over all tiles.
void project_backward(const View& view, const Gaussians& gaussians, std::int64_t i, const double moments[kMoments],
                      const GaussianGradients& gradients);

}  // namespace avatar::splat
