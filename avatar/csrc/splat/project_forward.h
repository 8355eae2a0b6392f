#pragma once
#include "splat/geometry.h"
#include "splat/tile_spans.h"

namespace avatar::splat {
namespace {

constexpr double kReachMargin = 1e-4;  // in log2 of alpha; far above float rounding there

constexpr double kMaxSide = 1 << 15;  // pixels of an image
constexpr double kFarthest = 1e37;    // (u, v) below which float32 holds them

inline Longs lanes_of(Visibility v) { return Longs{} + static_cast<int>(v); }
inline Doubles magnitude(Doubles v) { return v < 0.0 ? -v : v; }

// What is said of Gaussians before their colours are known.
struct alignas(64) Outlines {
    Footprints footprints;
    float opacity[kBatch];
    double depth[kBatch];
    double over_cutoff[kBatch];     // the opacity over alpha_min
    double xx[kBatch], yy[kBatch];  // of the covariance
    std::int64_t visibility[kBatch];
};

// Of the Gaussians in lanes `at` and following, all but the reach and what follows from it.
inline void outline(const View& view, const Batch& batch, int at, Outlines& to) {
    const Camera& camera = view.camera;
    const Settings& settings = view.settings;
    const Geometry g = geometry_of(view, batch, at);
    const Doubles root = square_root(g.yy), root_det = square_root(g.det);
    const Doubles given = load_as_doubles(batch.opacities + at);
    store_as_floats(to.opacity + at, settings.antialiased ? given * g.area / root_det : given);
    const Doubles opacity = load_as_doubles(to.opacity + at);
    store(to.depth + at, g.p[2]);
    const Doubles x = camera.fx * g.p[0] / g.p[2] + camera.cx, y = camera.fy * g.p[1] / g.p[2] + camera.cy;
    const Doubles a = kWhitening * root / root_det, b = -kWhitening * g.xy / (root * root_det), c = kWhitening / root;
    store(to.footprints.x + at, x);
    store(to.footprints.y + at, y);
    store(to.footprints.a + at, a);
    store(to.footprints.b + at, b);
    store(to.footprints.c + at, c);
    // What is farther from its own middle than float32 can say shows nowhere: a splat of 1e-30 pixels, without blur.
    const Doubles far_y = magnitude(y) + kMaxSide, far_u = a * (magnitude(x) + kMaxSide) + magnitude(b) * far_y;
    const Longs is_held = (far_u < kFarthest) & (c * far_y < kFarthest);
    const double alpha_min = settings.alpha_min;
    store(to.over_cutoff + at, opacity / alpha_min);
    store(to.xx + at, g.xx);
    store(to.yy + at, g.yy);
    const Longs transparent = lanes_of(Visibility::kTransparent);
    const Longs visibility = given < alpha_min            ? transparent
                             : ~(g.p[2] >= settings.near) ? lanes_of(Visibility::kNear)
                             : ~(g.has_area & is_held)    ? lanes_of(Visibility::kFlat)
                             : opacity < alpha_min        ? transparent
                                                          : lanes_of(Visibility::kVisible);
    __builtin_memcpy(to.visibility + at, &visibility, sizeof visibility);
}

// How far the splats reach, and whether that is to the region.
inline void find_reach(const View& view, Outlines& to) {
    const Settings& settings = view.settings;
    if (!(settings.alpha_min > 0.0f) || settings.everywhere) {
        for (float& reach : to.footprints.reach) reach = __builtin_inff();
        return;
    }
    alignas(64) double reach_of[kBatch];
    for (int lane = 0; lane < kBatch; ++lane) reach_of[lane] = __builtin_log2(to.over_cutoff[lane]);
    const Region& region = view.region;
    for (int at = 0; at < kBatch; at += kDoubles) {
        const Doubles reach = load(reach_of + at) + kReachMargin;
        store_as_floats(to.footprints.reach + at, reach);
        const Doubles half_x = square_root(reach * load(to.xx + at) / kHalfLog2E);
        const Doubles half_y = square_root(reach * load(to.yy + at) / kHalfLog2E);
        const Doubles x = load(to.footprints.x + at), y = load(to.footprints.y + at);
        const Longs outside = (x + half_x < double(region.left)) | (x - half_x > double(region.right)) |
                              (y + half_y < double(region.top)) | (y - half_y > double(region.bottom));
        Longs visibility;
        __builtin_memcpy(&visibility, to.visibility + at, sizeof visibility);
        const Longs left_out = outside & (visibility == lanes_of(Visibility::kVisible));
        visibility = left_out ? lanes_of(Visibility::kOutside) : visibility;
        __builtin_memcpy(to.visibility + at, &visibility, sizeof visibility);
    }
}

// Gaussians begin .. end - 1.
void project(const View& view, const Gaussians& gaussians, std::int64_t begin, std::int64_t end, const Projection& to) {
    const int degree = view.settings.sh_degree, values = 3 * (degree + 1) * (degree + 1);
    for (std::int64_t first = begin; first < end; first += kBatch) {
        const int count = end - first < kBatch ? static_cast<int>(end - first) : kBatch;
        std::int64_t indices[kBatch];
        for (int lane = 0; lane < kBatch; ++lane) indices[lane] = first + lane;
        Batch batch;
        batch.read(gaussians, indices, count, values);

        Outlines outlines;
        for (int at = 0; at < kBatch; at += kDoubles) outline(view, batch, at, outlines);
        find_reach(view, outlines);

        const Directions directions(view, batch);
        alignas(64) float colours[3][kBatch];
        for (int at = 0; at < kBatch; at += kLanes) {
            Floats basis[kMaxCoefficients], colour[3];
            sh_colour(degree, directions, batch, at, basis, colour);
            for (int c = 0; c < 3; ++c) store(colours[c] + at, colour[c]);
        }

        bool visible[kBatch] = {};
        const Footprints& f = outlines.footprints;
        for (int lane = 0; lane < count; ++lane) {
            const std::int64_t i = first + lane;
            auto visibility = static_cast<Visibility>(outlines.visibility[lane]);
            if (visibility == Visibility::kVisible) {
                float colour[3];
                for (int c = 0; c < 3; ++c) {
                    const float channel = colours[c][lane];
                    if (!(channel - channel == 0.0f)) visibility = Visibility::kColourOverflow;
                    colour[c] = channel > 0.0f ? channel : 0.0f;
                }
                visible[lane] = visibility == Visibility::kVisible;
                to.splats[i] = {f.x[lane], f.y[lane], f.a[lane], f.b[lane], f.c[lane], outlines.opacity[lane],
                                f.reach[lane], colour[0], colour[1], colour[2], 0.0f};
                to.depths[i] = outlines.depth[lane];
            }
            to.visibility[i] = visibility;
        }
        find_tiles(to, f, visible, count, to.tiles + (first - begin), to.pairs + first);
    }
}

bool all_finite(const float* values, std::int64_t count) {
    constexpr int kExponent = 0x7f800000;
    Ints bad{};
    std::int64_t i = 0;
    for (; i + kLanes <= count; i += kLanes) bad |= ((Ints)load_anywhere(values + i) & kExponent) == kExponent;
    bool finite = signs(bad) == 0;
    for (; i < count; ++i) finite &= values[i] - values[i] == 0.0f;
    return finite;
}

}  // namespace
}  // namespace avatar::splat
