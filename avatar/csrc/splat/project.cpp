#include "splat/project.h"

#include <cmath>
#include <limits>

#include "splat/sh.h"

namespace avatar::splat {
namespace {

constexpr double kWhitening = 0.84932180028801904272;  // the root of kHalfLog2E
constexpr double kReachMargin = 1e-4;                  // in log2 of alpha; far above float rounding there

double dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// The chain from a Gaussian to its covariance on the image plane, with what the derivative needs.
struct Geometry {
    double p[3];               // centre in camera coordinates
    double slope[2];           // x / z and y / z, clamped
    bool clamped[2];
    double quat[4];            // normalised
    double inv_length;         // 1 / |quaternion|, 0 for a zero quaternion
    double rotation[9];        // of the Gaussian
    double scales[3];
    double T[2][3];            // d(image) / d(world)
    double F[2][3];            // T * rotation * diag(scales): the covariance is F F^T + blur
    double cross[3], area;     // of the rows of F
    double xx, xy, yy, det;    // the covariance
};

double clamp(double value, const double range[2], bool& clamped) {
    clamped = value < range[0] || value > range[1];
    return value < range[0] ? range[0] : value > range[1] ? range[1] : value;
}

// False: not in front of the near plane.
bool transform_centre(const View& view, const float* mean, double p[3]) {
    const double* R = view.camera.rotation;
    for (int k = 0; k < 3; ++k)
        p[k] = R[3 * k] * mean[0] + R[3 * k + 1] * mean[1] + R[3 * k + 2] * mean[2] + view.camera.translation[k];
    return p[2] >= view.settings.near;
}

// Everything after the centre. False: no area on the image plane.
bool project_covariance(const View& view, const Gaussians& gaussians, std::int64_t i, Geometry& g) {
    const Camera& camera = view.camera;
    const double inv_z = 1.0 / g.p[2];
    g.slope[0] = clamp(g.p[0] * inv_z, view.slope_x, g.clamped[0]);
    g.slope[1] = clamp(g.p[1] * inv_z, view.slope_y, g.clamped[1]);
    const double* R = camera.rotation;
    for (int k = 0; k < 3; ++k) {
        g.T[0][k] = camera.fx * inv_z * (R[k] - g.slope[0] * R[6 + k]);
        g.T[1][k] = camera.fy * inv_z * (R[3 + k] - g.slope[1] * R[6 + k]);
        g.scales[k] = gaussians.scales[3 * i + k];
    }

    const float* q = gaussians.quats + 4 * i;
    const double squared = double(q[0]) * q[0] + double(q[1]) * q[1] + double(q[2]) * q[2] + double(q[3]) * q[3];
    g.inv_length = squared > 0.0 ? 1.0 / std::sqrt(squared) : 0.0;
    for (int k = 0; k < 4; ++k) g.quat[k] = squared > 0.0 ? q[k] * g.inv_length : (k == 0 ? 1.0 : 0.0);
    const double w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
    const double rotation[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                                2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                                2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    for (int k = 0; k < 9; ++k) g.rotation[k] = rotation[k];
    for (int r = 0; r < 2; ++r)
        for (int k = 0; k < 3; ++k)
            g.F[r][k] = (g.T[r][0] * rotation[k] + g.T[r][1] * rotation[3 + k] + g.T[r][2] * rotation[6 + k]) *
                        g.scales[k];

    // The determinant by Cauchy-Binet is a sum of squares, so it does not cancel for thin splats.
    const double* f0 = g.F[0];
    const double* f1 = g.F[1];
    g.cross[0] = f0[1] * f1[2] - f0[2] * f1[1];
    g.cross[1] = f0[2] * f1[0] - f0[0] * f1[2];
    g.cross[2] = f0[0] * f1[1] - f0[1] * f1[0];
    const double blur = view.settings.blur, area2 = dot(g.cross, g.cross);
    g.area = std::sqrt(area2);
    g.det = area2 + blur * (dot(f0, f0) + dot(f1, f1)) + blur * blur;
    g.xx = dot(f0, f0) + blur;
    g.xy = dot(f0, f1);
    g.yy = dot(f1, f1) + blur;
    return g.det > 0.0 && std::isfinite(g.det);
}

struct ViewDirection {
    double inv_distance;
    float d[3];
};

ViewDirection direction_to(const View& view, const float* mean) {
    const double v[3] = {mean[0] - view.centre[0], mean[1] - view.centre[1], mean[2] - view.centre[2]};
    const double inv = 1.0 / std::sqrt(dot(v, v));  // not zero: the centre is beyond the near plane
    return {inv, {float(v[0] * inv), float(v[1] * inv), float(v[2] * inv)}};
}

void sh_colour(int degree, const float d[3], const float* sh, float basis[kMaxCoefficients], float colour[3]) {
    sh_basis(degree, d, basis);
    const int used = (degree + 1) * (degree + 1);
    for (int c = 0; c < 3; ++c) colour[c] = 0.5f;
    for (int k = 0; k < used; ++k)
        for (int c = 0; c < 3; ++c) colour[c] += basis[k] * sh[3 * k + c];
}

// dL/dF (2x3) -> scales, quaternion and, through T, the camera-space centre.
void covariance_backward(const View& view, const Geometry& g, const double grad_F[2][3], double grad_p[3],
                         float* grad_quat, float* grad_scales) {
    const double* R = g.rotation;
    // F = T M, M = rotation * diag(scales)
    double grad_R[9], grad_T[2][3] = {};
    for (int k = 0; k < 3; ++k) {
        double grad_scale = 0.0;
        for (int r = 0; r < 3; ++r) {
            const double grad_M = g.T[0][r] * grad_F[0][k] + g.T[1][r] * grad_F[1][k];
            grad_scale += grad_M * R[3 * r + k];
            grad_R[3 * r + k] = grad_M * g.scales[k];
            for (int row = 0; row < 2; ++row) grad_T[row][r] += grad_F[row][k] * R[3 * r + k] * g.scales[k];
        }
        grad_scales[k] = float(grad_scale);
    }

    const double w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
    const double* G = grad_R;
    const double grad_q[4] = {
        2 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1])),
        2 * (w * (G[7] - G[5]) - 2 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6])),
        2 * (w * (G[2] - G[6]) + x * (G[1] + G[3]) - 2 * y * (G[0] + G[8]) + z * (G[5] + G[7])),
        2 * (w * (G[3] - G[1]) + x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2 * z * (G[0] + G[4]))};
    const double radial = grad_q[0] * w + grad_q[1] * x + grad_q[2] * y + grad_q[3] * z;
    for (int k = 0; k < 4; ++k) grad_quat[k] = float((grad_q[k] - radial * g.quat[k]) * g.inv_length);

    // T row = f / z * (R_row - slope * R_z); slope = p / z where it is not clamped
    const double* W = view.camera.rotation;
    const double inv_z = 1.0 / g.p[2], focal[2] = {view.camera.fx, view.camera.fy};
    for (int row = 0; row < 2; ++row) {
        const double along = dot(grad_T[row], W + 3 * row), along_z = dot(grad_T[row], W + 6);
        const double scale = focal[row] * inv_z;
        grad_p[2] -= scale * inv_z * (along - g.slope[row] * along_z);
        if (g.clamped[row]) continue;
        const double grad_slope = -scale * along_z;
        grad_p[row] += grad_slope * inv_z;
        grad_p[2] -= grad_slope * g.slope[row] * inv_z;
    }
}

}  // namespace

View::View(const Camera& camera_, const Settings& settings_, const Region& region_)
    : camera(camera_), settings(settings_), region(region_) {
    const double* R = camera.rotation;
    const double* t = camera.translation;
    for (int k = 0; k < 3; ++k) centre[k] = -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2]);
    const double margin_x = 0.3 * 0.5 * camera.width / camera.fx, margin_y = 0.3 * 0.5 * camera.height / camera.fy;
    slope_x[0] = -camera.cx / camera.fx - margin_x;
    slope_x[1] = (camera.width - camera.cx) / camera.fx + margin_x;
    slope_y[0] = -camera.cy / camera.fy - margin_y;
    slope_y[1] = (camera.height - camera.cy) / camera.fy + margin_y;
}

Visibility project(const View& view, const Gaussians& gaussians, std::int64_t i, Splat& splat, double& depth) {
    const Camera& camera = view.camera;
    const Settings& settings = view.settings;
    const float* mean = gaussians.means + 3 * i;
    if (gaussians.opacities[i] < settings.alpha_min) return Visibility::kTransparent;
    Geometry g;
    if (!transform_centre(view, mean, g.p)) return Visibility::kNear;
    if (!project_covariance(view, gaussians, i, g)) return Visibility::kFlat;
    splat.opacity = gaussians.opacities[i];
    if (settings.antialiased) splat.opacity = float(splat.opacity * g.area / std::sqrt(g.det));
    if (splat.opacity < settings.alpha_min) return Visibility::kTransparent;

    depth = g.p[2];
    splat.x = camera.fx * g.p[0] / g.p[2] + camera.cx;
    splat.y = camera.fy * g.p[1] / g.p[2] + camera.cy;
    const double root = std::sqrt(g.yy);
    splat.a = kWhitening * root / std::sqrt(g.det);
    splat.b = -kWhitening * g.xy / (root * std::sqrt(g.det));
    splat.c = kWhitening / root;
    splat.reach = std::numeric_limits<float>::infinity();
    if (settings.alpha_min > 0.0f && !settings.everywhere) {
        const double reach = std::log2(double(splat.opacity) / settings.alpha_min) + kReachMargin;
        splat.reach = float(reach);
        const double half_x = std::sqrt(reach * g.xx / kHalfLog2E), half_y = std::sqrt(reach * g.yy / kHalfLog2E);
        const Region& region = view.region;
        if (splat.x + half_x < region.left || splat.x - half_x > region.right || splat.y + half_y < region.top ||
            splat.y - half_y > region.bottom)
            return Visibility::kOutside;
    }

    float basis[kMaxCoefficients], colour[3];
    sh_colour(settings.sh_degree, direction_to(view, mean).d, gaussians.sh + 3 * gaussians.coefficients * i, basis,
              colour);
    for (float& channel : colour) {
        if (!std::isfinite(channel)) return Visibility::kColourOverflow;
        if (!(channel > 0.0f)) channel = 0.0f;
    }
    splat.red = colour[0], splat.green = colour[1], splat.blue = colour[2];
    return Visibility::kVisible;
}

void project_backward(const View& view, const Gaussians& gaussians, std::int64_t i, const double moments[kMoments],
                      const GaussianGradients& gradients) {
    const float* mean = gaussians.means + 3 * i;
    Geometry g;
    transform_centre(view, mean, g.p);
    project_covariance(view, gaussians, i, g);
    const double root_det = std::sqrt(g.det), root = std::sqrt(g.yy);
    const double a = kWhitening * root / root_det, b = -kWhitening * g.xy / (root * root_det), c = kWhitening / root;

    // alpha = opacity * shrink * 2^-(u^2 + v^2); `shrink` is 1 unless antialiased
    const double shrink = view.settings.antialiased ? g.area / root_det : 1.0;
    const double opacity = gaussians.opacities[i];
    gradients.opacities[i] = float(moments[kWeight] * shrink);

    // d log(alpha) / d(x, y) = 2 ln 2 * (a, 0; b, c) (u, v), and 2 ln 2 = 1 / kHalfLog2E
    const double weight = opacity * shrink, to_mean = weight / kHalfLog2E;
    const double grad_x = to_mean * a * moments[kU];
    const double grad_y = to_mean * (b * moments[kU] + c * moments[kV]);

    // d log(alpha) / d covariance = 1/2 (L^T y)(L^T y)^T with y = (u, v) / kWhitening and L = (a, b; 0, c) / kWhitening
    const double half = 0.5 * weight / (kHalfLog2E * kHalfLog2E);
    const double uu = moments[kUU], uv = moments[kUV], vv = moments[kVV];
    const double cov_xx = half * a * a * uu;
    const double cov_xy = half * a * (b * uu + c * uv);
    const double cov_yy = half * (b * (b * uu + c * uv) + c * (b * uv + c * vv));
    double grad_F[2][3];
    for (int k = 0; k < 3; ++k) {
        grad_F[0][k] = 2 * (cov_xx * g.F[0][k] + cov_xy * g.F[1][k]);
        grad_F[1][k] = 2 * (cov_xy * g.F[0][k] + cov_yy * g.F[1][k]);
    }
    if (view.settings.antialiased) {
        // shrink = area / sqrt(det), area = |F0 x F1|, det = area^2 + blur (|F0|^2 + |F1|^2) + blur^2
        const double grad_shrink = moments[kWeight] * opacity;
        const double inv_det = 1.0 / g.det, blur = view.settings.blur;
        const double grad_area = grad_shrink / root_det * (1.0 - g.area * g.area * inv_det);
        const double per_row = -grad_shrink * shrink * inv_det * blur;
        const double inv_area = g.area > 0.0 ? 1.0 / g.area : 0.0;
        const double n[3] = {g.cross[0] * inv_area, g.cross[1] * inv_area, g.cross[2] * inv_area};
        for (int k = 0; k < 3; ++k) {
            const int k1 = (k + 1) % 3, k2 = (k + 2) % 3;
            grad_F[0][k] += grad_area * (g.F[1][k1] * n[k2] - g.F[1][k2] * n[k1]) + per_row * g.F[0][k];
            grad_F[1][k] += grad_area * (n[k1] * g.F[0][k2] - n[k2] * g.F[0][k1]) + per_row * g.F[1][k];
        }
    }

    const double inv_z = 1.0 / g.p[2];
    const Camera& camera = view.camera;
    double grad_p[3] = {grad_x * camera.fx * inv_z, grad_y * camera.fy * inv_z,
                        -(grad_x * camera.fx * g.p[0] + grad_y * camera.fy * g.p[1]) * inv_z * inv_z};
    covariance_backward(view, g, grad_F, grad_p, gradients.quats + 4 * i, gradients.scales + 3 * i);

    const int degree = view.settings.sh_degree, used = (degree + 1) * (degree + 1);
    const std::int64_t offset = 3 * static_cast<std::int64_t>(gaussians.coefficients) * i;
    const float* sh = gaussians.sh + offset;
    float* grad_sh = gradients.sh + offset;
    const ViewDirection direction = direction_to(view, mean);
    float basis[kMaxCoefficients], colour[3], grad_basis[kMaxCoefficients], grad_d[3] = {};
    sh_colour(degree, direction.d, sh, basis, colour);
    float grad_colour[3];
    for (int c = 0; c < 3; ++c) grad_colour[c] = colour[c] > 0.0f ? float(moments[kRed + c]) : 0.0f;
    for (int k = 0; k < used; ++k) {
        grad_basis[k] = 0.0f;
        for (int c = 0; c < 3; ++c) {
            grad_sh[3 * k + c] = basis[k] * grad_colour[c];
            grad_basis[k] += sh[3 * k + c] * grad_colour[c];
        }
    }
    for (int k = 3 * used; k < 3 * gaussians.coefficients; ++k) grad_sh[k] = 0.0f;
    sh_basis_backward(degree, direction.d, grad_basis, grad_d);
    const double along = double(grad_d[0]) * direction.d[0] + double(grad_d[1]) * direction.d[1] +
                         double(grad_d[2]) * direction.d[2];

    const double* R = camera.rotation;
    for (int k = 0; k < 3; ++k) {
        const double through_view = R[k] * grad_p[0] + R[3 + k] * grad_p[1] + R[6 + k] * grad_p[2];
        const double through_colour = (grad_d[k] - along * direction.d[k]) * direction.inv_distance;
        gradients.means[3 * i + k] = float(through_view + through_colour);
    }
}

}  // namespace avatar::splat
