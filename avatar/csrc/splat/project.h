#pragma once
#include "splat/scene.h"

// Gaussian -> Splat and its derivative: pinhole projection of mean and covariance (Zwicker et al. 2002), colour from
// spherical harmonics. The geometry is in double: scales of 1e-12 and of 1e6 in one scene must give neither zeros nor
// NaN. The functions are kernels (kernels.h); this is what they take and give.
namespace avatar::splat {

constexpr int kBatch = 16;  // Gaussians that a kernel takes together

// What is the same for all Gaussians of one call.
struct View {
    View(const Camera& camera, const Settings& settings, const Region& region);

    Camera camera;
    Settings settings;
    Region region;
    double centre[3];               // of the camera, world
    double slope_x[2], slope_y[2];  // range to which x / z and y / z are clamped in the Jacobian
};

// Why a Gaussian is not drawn, or that it is. Hidden, in the order of the enumeration: opacity below alpha_min, nearer
// than `near`, no area on the image plane that float32 can measure, no pixel of the region where alpha can reach alpha_min.
enum class Visibility : unsigned char { kVisible, kTransparent, kNear, kFlat, kOutside, kColourOverflow };

// Tiles next to each other in a row; none where first > last.
struct Span {
    std::uint32_t first, last;
};

// The tiles in which a splat has a pixel centre that its ellipse of alpha >= alpha_min may contain.
struct TileSpans {
    const Span* spans;
    std::uint32_t count;
};

// Where the projection of N Gaussians goes. Splats, depths and spans are written for visible ones only.
struct Projection {
    TileGrid grid;
    Splat* splats;            // [N]
    double* depths;           // [N] of the centres
    Visibility* visibility;   // [N]
    TileSpans* tiles;         // of the first Gaussian that is projected and those that follow it
    std::uint32_t* pairs;     // [N] tiles in all spans of a Gaussian, 0 where it is hidden
    Span* (*take)(void* store, std::int64_t count);  // memory for so many spans
    void* store;
};

}  // namespace avatar::splat
