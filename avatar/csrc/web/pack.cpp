// What a viewer on another device draws by itself: colours, covariances and order, so that its own thread only uploads.
#include <algorithm>
#include <cmath>

#include "splat/sh.h"
#include "web/web_avatar.h"

namespace avatar::web {
namespace {

constexpr int kSteps = 1 << 16;  // between the nearest and the farthest: 5 micrometres of a head's 30 centimetres

// Indices by falling depth.
void sort_farthest_first(const std::vector<float>& depths, std::vector<std::uint32_t>& order) {
    const auto [near, far] = std::minmax_element(depths.begin(), depths.end());
    const float nearest = *near, scale = *far > *near ? (kSteps - 1) / (*far - *near) : 0.0f;
    const auto step = [&](float depth) {  // also where the depths differ by too little or too much for float32
        return kSteps - 1 - static_cast<int>(std::min<float>(kSteps - 1, (depth - nearest) * scale));
    };
    std::vector<std::uint32_t> begin(kSteps + 1, 0);
    for (const float depth : depths) ++begin[step(depth) + 1];
    for (int k = 0; k < kSteps; ++k) begin[k + 1] += begin[k];
    order.resize(depths.size());
    for (std::size_t i = 0; i < depths.size(); ++i) order[begin[step(depths[i])]++] = static_cast<std::uint32_t>(i);
}

// R S S^T R^T of a quaternion (w, x, y, z) of any length.
void covariance(const float* quat, const float* scales, float out[6]) {
    const float norm = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    const float w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
    const float R[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                        2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                        2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    int at = 0;
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j) {
            out[at] = 0;
            for (int k = 0; k < 3; ++k) out[at] += scales[k] * scales[k] * R[3 * i + k] * R[3 * j + k];
            ++at;
        }
}

}  // namespace

const float* WebAvatar::pack(const splat::Camera& camera) {
    const std::int64_t G = sizes_.gaussians;
    const int K = sizes_.coefficients;
    const double *R = camera.rotation, *t = camera.translation;
    float eye[3];  // the camera's place in the world, -R^T t
    for (int i = 0; i < 3; ++i) eye[i] = static_cast<float>(-(R[i] * t[0] + R[3 + i] * t[1] + R[6 + i] * t[2]));
    int degree = 0;
    while ((degree + 2) * (degree + 2) <= K) ++degree;

    std::vector<float> depths(G);
    for (std::int64_t g = 0; g < G; ++g) {
        const float* mean = means_.data() + 3 * g;
        const float depth = static_cast<float>(R[6] * mean[0] + R[7] * mean[1] + R[8] * mean[2] + t[2]);
        depths[g] = std::isfinite(depth) ? depth : 0.0f;
    }
    sort_farthest_first(depths, order_);

    packed_.resize(G * kPacked);
    for (std::int64_t begin = 0; begin < G; begin += kLanes) {
        const int count = static_cast<int>(std::min<std::int64_t>(kLanes, G - begin));
        Floats direction[3] = {}, basis[splat::kMaxCoefficients];
        for (int lane = 0; lane < count; ++lane) {
            const float* mean = means_.data() + 3 * std::int64_t{order_[begin + lane]};
            const float d[3] = {mean[0] - eye[0], mean[1] - eye[1], mean[2] - eye[2]};
            const float norm = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            for (int k = 0; k < 3; ++k) direction[k][lane] = norm > 0 ? d[k] / norm : 0.0f;
        }
        splat::sh_basis(degree, direction, basis);
        for (int lane = 0; lane < count; ++lane) {
            const std::int64_t g = order_[begin + lane];
            float* to = packed_.data() + (begin + lane) * kPacked;
            std::copy_n(means_.data() + 3 * g, 3, to);
            to[3] = opacities_[g];
            const float* sh = arrays_[kSh].data() + g * K * 3;
            for (int c = 0; c < 3; ++c) {
                float colour = 0.5f;
                for (int k = 0; k < K; ++k) colour += basis[k][lane] * sh[3 * k + c];
                to[4 + c] = std::max(colour, 0.0f);
            }
            covariance(quats_.data() + 4 * g, scales_.data() + 3 * g, to + 7);
        }
    }
    return packed_.data();
}

}  // namespace avatar::web
