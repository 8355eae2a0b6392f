#pragma once
#include <cstdint>

// The plain data that the stages of the splatter hand to each other. All matrices are row-major.
namespace avatar::splat {

// N Gaussians as the caller gives them; `coefficients` is K, the stored spherical-harmonics coefficients a channel. With
// features they have no coefficients, and the degree is kNoSh.
struct Gaussians {
    const float* means;      // [N * 3]
    const float* quats;      // [N * 4], (w, x, y, z), any length
    const float* scales;     // [N * 3]
    const float* opacities;  // [N]
    const float* sh;         // [N * K * 3]
    std::int64_t count;
    int coefficients;
    const float* features = nullptr;  // [N * channels]
    int channels = 0;                 // of the features; 0: colours
};
constexpr int kNoSh = -1;

struct GaussianGradients {
    float* means;
    float* quats;
    float* scales;
    float* opacities;
    float* sh;
    float* features = nullptr;
};

struct Camera {
    double rotation[9];     // R_cam_world
    double translation[3];  // t_cam_world, metres
    double fx, fy, cx, cy;  // pixels
    int width, height;
};
constexpr int kPoseValues = 12;  // of a gradient of the pose: rotation, then translation

// The part of the image that is drawn, in pixels: columns left to right - 1, rows top to bottom - 1. Not empty.
struct Region {
    int left, top, right, bottom;
};

struct Settings {
    int sh_degree;
    float alpha_min, alpha_max, t_min;
    double blur;  // pixels^2
    double near;  // metres
    bool antialiased;
    bool everywhere;  // for tests: look for every splat at every pixel, as if nothing were known of its extent
};

constexpr double kHalfLog2E = 0.72134752044448170368;  // log2(e) / 2

// A visible Gaussian on the image plane; one line of the caches.
//
// With d = pixel - (x, y), u = a d_x + b d_y and v = c d_y, the splat's alpha is opacity * 2^-(u^2 + v^2): (a, b; 0, c)
// is the Cholesky-type factor of the inverse covariance, times sqrt(kHalfLog2E). Squares of whitened coordinates do
// not cancel, while the usual quadratic form of the conic loses all digits for long thin splats seen at an angle. The
// factor is kept in double because (x, y) may lie far outside the image.
struct Splat {
    double x, y;
    double a, b, c;
    float opacity;
    float reach;  // alpha can reach alpha_min only where u^2 + v^2 <= reach; rounded up, infinite for alpha_min = 0
    float red, green, blue;
    float unused;
};
static_assert(sizeof(Splat) == 64);

// One splat, by its Gaussian, in one tile. `slot` counts the pairs Gaussian by Gaussian, so that all pairs of a splat are
// adjacent there: where the backward pass leaves what it finds, to be summed in a fixed order.
struct Pair {
    std::uint32_t splat, slot;
};

// What the rasteriser's backward pass finds for one splat in one tile, and the sum of that over tiles.
// `weight` = dL/dalpha * alpha / opacity, summed over pixels; the others are its moments in (u, v).
enum Moment { kWeight, kU, kUU, kV, kUV, kVV, kRed, kGreen, kBlue, kMoments };
constexpr int kShapeMoments = kRed;  // those that features have too; dL/dfeature of each channel follows them

// Pixels. Larger tiles repeat less work for a splat; the pixels of one still fit in L1. docs/bench/splat.md has timings.
constexpr int kTileWidth = 32, kTileHeight = 32, kTilePixels = kTileWidth * kTileHeight;

// The tiles that meet the region. They lie where those of the whole image do, so that a pixel gets the same bits in any
// region.
struct TileGrid {
    explicit TileGrid(const Region& r)
        : region(r), first_x(r.left / kTileWidth), first_y(r.top / kTileHeight),
          count_x((r.right - 1) / kTileWidth - first_x + 1), count_y((r.bottom - 1) / kTileHeight - first_y + 1) {}
    std::int64_t count() const { return std::int64_t{count_x} * count_y; }

    Region region;
    int first_x, first_y, count_x, count_y;
};

}  // namespace avatar::splat
