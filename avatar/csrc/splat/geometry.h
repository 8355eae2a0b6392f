#pragma once
// The chain from Gaussians to their covariances on the image plane, for as many as a vector has doubles. Every lane
// rounds as a scalar would, so that the bits are the same for every instruction set. Included only by the kernels.
#include "splat/project.h"
#include "splat/sh.h"
#include "transpose.h"

namespace avatar::splat {
namespace {

constexpr double kWhitening = 0.84932180028801904272;  // the root of kHalfLog2E
static_assert(kBatch % kLanes == 0);

inline Doubles dot(const Doubles a[3], const Doubles b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline Doubles dot(const Doubles a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// The values of a few Gaussians, side by side.
struct alignas(64) Batch {
    float means[3][kBatch], quats[4][kBatch], scales[3][kBatch], opacities[kBatch];
    float sh[3 * kMaxCoefficients][kBatch];  // the first `values` of them

    // In lanes from `count` on stands the first Gaussian once more.
    void read(const Gaussians& gaussians, const std::int64_t* indices, int count, int values) {
        const float *mean_rows[kBatch], *quat_rows[kBatch], *scale_rows[kBatch], *sh_rows[kBatch];
        for (int lane = 0; lane < kBatch; ++lane) {
            const std::int64_t i = indices[lane < count ? lane : 0];
            mean_rows[lane] = gaussians.means + 3 * i;
            quat_rows[lane] = gaussians.quats + 4 * i;
            scale_rows[lane] = gaussians.scales + 3 * i;
            sh_rows[lane] = gaussians.sh + 3 * gaussians.coefficients * i;
            opacities[lane] = gaussians.opacities[i];
        }
        transpose_in<kBatch>(mean_rows, 3, means);
        transpose_in<kBatch>(quat_rows, 4, quats);
        transpose_in<kBatch>(scale_rows, 3, scales);
        transpose_in<kBatch>(sh_rows, values, sh);
    }
};

struct Geometry {
    Doubles p[3], inv_z;        // centre in camera coordinates
    Doubles slope[2];           // x / z and y / z, clamped
    Longs clamped[2];
    Doubles quat[4];            // normalised
    Doubles inv_length;         // 1 / |quaternion|, 0 for a zero quaternion
    Doubles rotation[9];        // of the Gaussian
    Doubles scales[3];
    Doubles T[2][3];            // d(image) / d(world)
    Doubles F[2][3];            // T * rotation * diag(scales): the covariance is F F^T + blur
    Doubles cross[3], area;     // of the rows of F
    Doubles xx, xy, yy, det;    // the covariance
    Longs has_area;             // on the image plane
};

inline Doubles clamp(Doubles value, const double range[2], Longs& clamped) {
    const Longs below = value < range[0], above = value > range[1];
    clamped = below | above;
    return below ? Doubles{} + range[0] : above ? Doubles{} + range[1] : value;
}

inline Longs is_finite(Doubles v) { return v - v == 0.0; }

// Of the Gaussians in lanes `at` and following of the batch.
__attribute__((always_inline)) inline Geometry geometry_of(const View& view, const Batch& batch, int at) {
    const Camera& camera = view.camera;
    Geometry g;
    const double* R = camera.rotation;
    const Doubles mean[3] = {load_as_doubles(batch.means[0] + at), load_as_doubles(batch.means[1] + at),
                             load_as_doubles(batch.means[2] + at)};
    for (int k = 0; k < 3; ++k)
        g.p[k] = R[3 * k] * mean[0] + R[3 * k + 1] * mean[1] + R[3 * k + 2] * mean[2] + camera.translation[k];
    g.inv_z = 1.0 / g.p[2];
    g.slope[0] = clamp(g.p[0] * g.inv_z, view.slope_x, g.clamped[0]);
    g.slope[1] = clamp(g.p[1] * g.inv_z, view.slope_y, g.clamped[1]);
    const Doubles scale_x = camera.fx * g.inv_z, scale_y = camera.fy * g.inv_z;
    for (int k = 0; k < 3; ++k) {
        g.T[0][k] = scale_x * (R[k] - g.slope[0] * R[6 + k]);
        g.T[1][k] = scale_y * (R[3 + k] - g.slope[1] * R[6 + k]);
        g.scales[k] = load_as_doubles(batch.scales[k] + at);
    }

    Doubles q[4];
    for (int k = 0; k < 4; ++k) q[k] = load_as_doubles(batch.quats[k] + at);
    const Doubles squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const Longs turned = squared > 0.0;
    g.inv_length = turned ? 1.0 / square_root(squared) : Doubles{};
    for (int k = 0; k < 4; ++k) g.quat[k] = turned ? q[k] * g.inv_length : Doubles{} + (k == 0 ? 1.0 : 0.0);
    const Doubles w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
    g.rotation[0] = 1.0 - 2.0 * (y * y + z * z);
    g.rotation[1] = 2.0 * (x * y - w * z);
    g.rotation[2] = 2.0 * (x * z + w * y);
    g.rotation[3] = 2.0 * (x * y + w * z);
    g.rotation[4] = 1.0 - 2.0 * (x * x + z * z);
    g.rotation[5] = 2.0 * (y * z - w * x);
    g.rotation[6] = 2.0 * (x * z - w * y);
    g.rotation[7] = 2.0 * (y * z + w * x);
    g.rotation[8] = 1.0 - 2.0 * (x * x + y * y);
    for (int r = 0; r < 2; ++r)
        for (int k = 0; k < 3; ++k)
            g.F[r][k] = (g.T[r][0] * g.rotation[k] + g.T[r][1] * g.rotation[3 + k] + g.T[r][2] * g.rotation[6 + k]) *
                        g.scales[k];

    // The determinant by Cauchy-Binet is a sum of squares, so it does not cancel for thin splats.
    const Doubles *f0 = g.F[0], *f1 = g.F[1];
    g.cross[0] = f0[1] * f1[2] - f0[2] * f1[1];
    g.cross[1] = f0[2] * f1[0] - f0[0] * f1[2];
    g.cross[2] = f0[0] * f1[1] - f0[1] * f1[0];
    const double blur = view.settings.blur;
    const Doubles area2 = dot(g.cross, g.cross), square0 = dot(f0, f0), square1 = dot(f1, f1);
    g.area = square_root(area2);
    g.det = area2 + blur * (square0 + square1) + blur * blur;
    g.xx = square0 + blur;
    g.xy = dot(f0, f1);
    g.yy = square1 + blur;
    g.has_area = (g.det > 0.0) & is_finite(g.det);
    return g;
}

// Unit vectors from the camera to the centres.
struct alignas(64) Directions {
    float d[3][kBatch];
    double inv_distance[kBatch];

    Directions(const View& view, const Batch& batch) {
        for (int at = 0; at < kBatch; at += kDoubles) {
            Doubles v[3];
            for (int k = 0; k < 3; ++k) v[k] = load_as_doubles(batch.means[k] + at) - view.centre[k];
            const Doubles inverse = 1.0 / square_root(dot(v, v));  // finite: the centre is beyond the near plane
            for (int k = 0; k < 3; ++k) store_as_floats(d[k] + at, v[k] * inverse);
            store(inv_distance + at, inverse);
        }
    }
};

// The colour of kLanes Gaussians before it is clamped, and the basis that it was found with.
inline void sh_colour(int degree, const Directions& directions, const Batch& batch, int at,
                      Floats basis[kMaxCoefficients], Floats colour[3]) {
    const Floats d[3] = {load(directions.d[0] + at), load(directions.d[1] + at), load(directions.d[2] + at)};
    sh_basis(degree, d, basis);
    const int used = (degree + 1) * (degree + 1);
    for (int c = 0; c < 3; ++c) colour[c] = broadcast(0.5f);
    for (int k = 0; k < used; ++k)
        for (int c = 0; c < 3; ++c) colour[c] += basis[k] * load(batch.sh[3 * k + c] + at);
}

}  // namespace
}  // namespace avatar::splat
