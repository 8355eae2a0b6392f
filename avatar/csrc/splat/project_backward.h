#pragma once
#include "splat/geometry.h"

namespace avatar::splat {
namespace {

// What a batch of Gaussians gets back: the sums of the moments of its splats, and their gradients.
struct alignas(64) Sums {
    double moments[kMoments][kBatch];
};

struct alignas(64) BatchGradients {
    double p[3][kBatch];  // of the centre in camera coordinates
    float quats[4][kBatch], scales[3][kBatch], opacities[kBatch], means[3][kBatch];
    float sh[3 * kMaxCoefficients][kBatch];
};

// The gradient of the camera's pose, R (9 values) and t (3), a sum over Gaussians in each lane. By p = R m + t, by
// T row = f / z (R_row - slope R_z), and by the direction d along m + R^T t, which the colour depends on:
//     dL/dR = sum of (dL/dp) m^T + t (dL/dm by d)^T + dL/dR by T,    dL/dt = sum of dL/dp + R (dL/dm by d)
struct alignas(64) PoseSums {
    double values[kPoseValues][kBatch];

    void add(int value, int at, Doubles term) { store(values[value] + at, load(values[value] + at) + term); }
};

// dL/dF (2x3) -> scales, quaternion and, through T, the camera-space centre and the pose.
inline void covariance_backward(const View& view, const Geometry& g, const Doubles grad_F[2][3], Doubles grad_p[3],
                                int at, BatchGradients& to, PoseSums* pose) {
    const Doubles* R = g.rotation;
    // F = T M, M = rotation * diag(scales)
    Doubles G[9], grad_T[2][3] = {};
    for (int k = 0; k < 3; ++k) {
        Doubles grad_scale{};
        for (int r = 0; r < 3; ++r) {
            const Doubles grad_M = g.T[0][r] * grad_F[0][k] + g.T[1][r] * grad_F[1][k];
            grad_scale += grad_M * R[3 * r + k];
            G[3 * r + k] = grad_M * g.scales[k];
            for (int row = 0; row < 2; ++row) grad_T[row][r] += grad_F[row][k] * R[3 * r + k] * g.scales[k];
        }
        store_as_floats(to.scales[k] + at, grad_scale);
    }

    const Doubles w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
    const Doubles grad_q[4] = {
        2.0 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1])),
        2.0 * (w * (G[7] - G[5]) - 2.0 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6])),
        2.0 * (w * (G[2] - G[6]) + x * (G[1] + G[3]) - 2.0 * y * (G[0] + G[8]) + z * (G[5] + G[7])),
        2.0 * (w * (G[3] - G[1]) + x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2.0 * z * (G[0] + G[4]))};
    const Doubles radial = grad_q[0] * w + grad_q[1] * x + grad_q[2] * y + grad_q[3] * z;
    for (int k = 0; k < 4; ++k)
        store_as_floats(to.quats[k] + at, (grad_q[k] - radial * g.quat[k]) * g.inv_length);

    // T row = f / z * (R_row - slope * R_z); slope = p / z where it is not clamped
    const double *W = view.camera.rotation, focal[2] = {view.camera.fx, view.camera.fy};
    for (int row = 0; row < 2; ++row) {
        const Doubles along = dot(grad_T[row], W + 3 * row), along_z = dot(grad_T[row], W + 6);
        const Doubles scale = focal[row] * g.inv_z;
        grad_p[2] -= scale * g.inv_z * (along - g.slope[row] * along_z);
        const Doubles grad_slope = -scale * along_z;
        grad_p[row] = g.clamped[row] ? grad_p[row] : grad_p[row] + grad_slope * g.inv_z;
        grad_p[2] = g.clamped[row] ? grad_p[2] : grad_p[2] - grad_slope * g.slope[row] * g.inv_z;
        if (pose == nullptr) continue;
        for (int k = 0; k < 3; ++k) {
            pose->add(3 * row + k, at, scale * grad_T[row][k]);
            pose->add(6 + k, at, -scale * g.slope[row] * grad_T[row][k]);
        }
    }
}

// Through the ellipse and the opacity, for the Gaussians in lanes `at` and following.
inline void outline_backward(const View& view, const Batch& batch, const Sums& sums, int at, BatchGradients& to,
                             PoseSums* pose) {
    const Geometry g = geometry_of(view, batch, at);
    const auto moment = [&](Moment m) { return load(sums.moments[m] + at); };
    const Doubles root_det = square_root(g.det), root = square_root(g.yy);
    const Doubles a = kWhitening * root / root_det, b = -kWhitening * g.xy / (root * root_det), c = kWhitening / root;

    // alpha = opacity * shrink * 2^-(u^2 + v^2); `shrink` is 1 unless antialiased
    const bool antialiased = view.settings.antialiased;
    const Doubles shrink = antialiased ? g.area / root_det : Doubles{} + 1.0;
    const Doubles opacity = load_as_doubles(batch.opacities + at);
    store_as_floats(to.opacities + at, moment(kWeight) * shrink);

    // d log(alpha) / d(x, y) = 2 ln 2 * (a, 0; b, c) (u, v), and 2 ln 2 = 1 / kHalfLog2E
    const Doubles weight = opacity * shrink, to_mean = weight / kHalfLog2E;
    const Doubles grad_x = to_mean * a * moment(kU);
    const Doubles grad_y = to_mean * (b * moment(kU) + c * moment(kV));

    // d log(alpha) / d covariance = 1/2 (L^T y)(L^T y)^T with y = (u, v) / kWhitening and L = (a, b; 0, c) / kWhitening
    const Doubles half = 0.5 * weight / (kHalfLog2E * kHalfLog2E);
    const Doubles uu = moment(kUU), uv = moment(kUV), vv = moment(kVV);
    const Doubles cov_xx = half * a * a * uu;
    const Doubles cov_xy = half * a * (b * uu + c * uv);
    const Doubles cov_yy = half * (b * (b * uu + c * uv) + c * (b * uv + c * vv));
    Doubles grad_F[2][3];
    for (int k = 0; k < 3; ++k) {
        grad_F[0][k] = 2.0 * (cov_xx * g.F[0][k] + cov_xy * g.F[1][k]);
        grad_F[1][k] = 2.0 * (cov_xy * g.F[0][k] + cov_yy * g.F[1][k]);
    }
    if (antialiased) {
        // shrink = area / sqrt(det), area = |F0 x F1|, det = area^2 + blur (|F0|^2 + |F1|^2) + blur^2
        const Doubles grad_shrink = moment(kWeight) * opacity;
        const Doubles inv_det = 1.0 / g.det, one_over_area = 1.0 / g.area;
        const Doubles grad_area = grad_shrink / root_det * (1.0 - g.area * g.area * inv_det);
        const Doubles per_row = -grad_shrink * shrink * inv_det * view.settings.blur;
        const Doubles inv_area = g.area > 0.0 ? one_over_area : Doubles{};
        const Doubles n[3] = {g.cross[0] * inv_area, g.cross[1] * inv_area, g.cross[2] * inv_area};
        for (int k = 0; k < 3; ++k) {
            const int k1 = (k + 1) % 3, k2 = (k + 2) % 3;
            grad_F[0][k] += grad_area * (g.F[1][k1] * n[k2] - g.F[1][k2] * n[k1]) + per_row * g.F[0][k];
            grad_F[1][k] += grad_area * (n[k1] * g.F[0][k2] - n[k2] * g.F[0][k1]) + per_row * g.F[1][k];
        }
    }

    const Camera& camera = view.camera;
    Doubles grad_p[3] = {grad_x * camera.fx * g.inv_z, grad_y * camera.fy * g.inv_z,
                         -(grad_x * camera.fx * g.p[0] + grad_y * camera.fy * g.p[1]) * g.inv_z * g.inv_z};
    covariance_backward(view, g, grad_F, grad_p, at, to, pose);
    for (int k = 0; k < 3; ++k) store(to.p[k] + at, grad_p[k]);
}

// Through the colour. The gradient of the direction stands in `grad_d` afterwards, as if its components were independent.
inline void colour_backward(int degree, const Directions& directions, const Batch& batch, const Sums& sums, int at,
                            BatchGradients& to, float grad_d[3][kBatch]) {
    const int used = (degree + 1) * (degree + 1);
    Floats basis[kMaxCoefficients], colour[3], grad_basis[kMaxCoefficients], by_direction[3] = {};
    sh_colour(degree, directions, batch, at, basis, colour);
    Floats grad_colour[3];
    for (int c = 0; c < 3; ++c) {
        alignas(64) float shown[kLanes];
        for (int half = 0; half < kLanes; half += kDoubles)
            store_as_floats(shown + half, load(sums.moments[kRed + c] + at + half));
        grad_colour[c] = colour[c] > 0.0f ? load(shown) : Floats{};
    }
    for (int k = 0; k < used; ++k) {
        grad_basis[k] = Floats{};
        for (int c = 0; c < 3; ++c) {
            store(to.sh[3 * k + c] + at, basis[k] * grad_colour[c]);
            grad_basis[k] += load(batch.sh[3 * k + c] + at) * grad_colour[c];
        }
    }
    const Floats d[3] = {load(directions.d[0] + at), load(directions.d[1] + at), load(directions.d[2] + at)};
    sh_basis_backward(degree, d, grad_basis, by_direction);
    for (int k = 0; k < 3; ++k) store(grad_d[k] + at, by_direction[k]);
}

inline void means_backward(const View& view, const Batch& batch, const Directions& directions,
                           const float grad_d[3][kBatch], int at, BatchGradients& to, PoseSums* pose) {
    Doubles d[3], by_d[3], by_p[3], through_colour[3];
    for (int k = 0; k < 3; ++k) {
        d[k] = load_as_doubles(directions.d[k] + at);
        by_d[k] = load_as_doubles(grad_d[k] + at);
        by_p[k] = load(to.p[k] + at);
    }
    const Doubles along = dot(by_d, d), inv_distance = load(directions.inv_distance + at);
    const double* R = view.camera.rotation;
    for (int k = 0; k < 3; ++k) {
        const Doubles through_view = R[k] * by_p[0] + R[3 + k] * by_p[1] + R[6 + k] * by_p[2];
        through_colour[k] = (by_d[k] - along * d[k]) * inv_distance;
        store_as_floats(to.means[k] + at, through_view + through_colour[k]);
    }
    if (pose == nullptr) return;
    const double* t = view.camera.translation;
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k)
            pose->add(3 * row + k, at, by_p[row] * load_as_doubles(batch.means[k] + at) + t[row] * through_colour[k]);
        pose->add(9 + row, at, by_p[row] + dot(through_colour, R + 3 * row));
    }
}

// Writes (does not add) the gradients of the Gaussians with these indices, from the moments of their splats. Adds to
// `pose`, which is null where nobody asks for it; all moments in lanes from `count` on are 0.
inline void batch_backward(const View& view, const Gaussians& gaussians, const std::int64_t* indices, int count,
                           const Sums& sums, const GaussianGradients& gradients, PoseSums* pose) {
    const int degree = view.settings.sh_degree, values = 3 * (degree + 1) * (degree + 1);
    Batch batch;
    batch.read(gaussians, indices, count, values);
    const Directions directions(view, batch);
    BatchGradients found;
    alignas(64) float grad_d[3][kBatch];
    for (int at = 0; at < kBatch; at += kDoubles) outline_backward(view, batch, sums, at, found, pose);
    for (int at = 0; at < kBatch; at += kLanes) colour_backward(degree, directions, batch, sums, at, found, grad_d);
    for (int at = 0; at < kBatch; at += kDoubles)
        means_backward(view, batch, directions, grad_d, at, found, pose);

    float unused[3 * kMaxCoefficients];
    float *mean_rows[kBatch], *quat_rows[kBatch], *scale_rows[kBatch], *sh_rows[kBatch];
    const std::int64_t stored = 3 * std::int64_t{gaussians.coefficients};
    for (int lane = 0; lane < kBatch; ++lane) {
        const bool is_one = lane < count;
        const std::int64_t i = is_one ? indices[lane] : 0;
        mean_rows[lane] = is_one ? gradients.means + 3 * i : unused;
        quat_rows[lane] = is_one ? gradients.quats + 4 * i : unused;
        scale_rows[lane] = is_one ? gradients.scales + 3 * i : unused;
        sh_rows[lane] = is_one ? gradients.sh + stored * i : unused;
        if (is_one) gradients.opacities[i] = found.opacities[lane];
        if (is_one && values < stored) __builtin_memset(sh_rows[lane] + values, 0, (stored - values) * sizeof(float));
    }
    transpose_out<kBatch>(found.means, 3, mean_rows);
    transpose_out<kBatch>(found.quats, 4, quat_rows);
    transpose_out<kBatch>(found.scales, 3, scale_rows);
    transpose_out<kBatch>(found.sh, values, sh_rows);
}

inline void clear(const GaussianGradients& gradients, std::int64_t i, std::int64_t sh_values) {
    __builtin_memset(gradients.means + 3 * i, 0, 3 * sizeof(float));
    __builtin_memset(gradients.quats + 4 * i, 0, 4 * sizeof(float));
    __builtin_memset(gradients.scales + 3 * i, 0, 3 * sizeof(float));
    gradients.opacities[i] = 0.0f;
    if (sh_values != 0) __builtin_memset(gradients.sh + sh_values * i, 0, sh_values * sizeof(float));
}

}  // namespace
}  // namespace avatar::splat
