#include "web/web_avatar.h"

#include <algorithm>
#include <cmath>

#include "apply_offsets/apply_offsets.h"
#include "hyper/kernels.h"
#include "web/layer.h"

namespace avatar::web {
namespace {

// y += a * x
void add_scaled(std::vector<float>& y, const float* x, float a) {
    const std::size_t count = y.size();
    float* to = y.data();
    for (std::size_t i = 0; i < count; ++i) to[i] += a * x[i];
}

// The first two rows, made orthonormal, and their cross product: matrix_from_6d of avatar/head/model.py.
Rotation rotation_from_6d(const float* v) {
    Rotation r{};
    const auto normalize = [](float* x) {
        const float norm = std::max(std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), 1e-12f);
        for (int i = 0; i < 3; ++i) x[i] /= norm;
    };
    float *a = r.m, *b = r.m + 3, *c = r.m + 6;
    std::copy(v, v + 3, a);
    normalize(a);
    const float along = a[0] * v[3] + a[1] * v[4] + a[2] * v[5];
    for (int i = 0; i < 3; ++i) b[i] = v[3 + i] - along * a[i];
    normalize(b);
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
    return r;
}

Rotation transposed(const Rotation& a) {
    return {{a.m[0], a.m[3], a.m[6], a.m[1], a.m[4], a.m[7], a.m[2], a.m[5], a.m[8]}};
}

Rotation product(const Rotation& a, const Rotation& b) {
    Rotation r{};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) r.m[3 * i + j] += a.m[3 * i + k] * b.m[3 * k + j];
    return r;
}

}  // namespace

void array_lengths(const Sizes& s, std::int64_t lengths[kArrays]) {
    const std::int64_t V = s.vertices, E = s.expressions, G = s.gaussians, M = s.nodes, W = s.width, H = s.layers - 1;
    const std::int64_t values[kArrays] = {
        V * 3, E * V * 3, kPoseValues * V * 3, V * kJoints, kEyelids * V * 3, kJoints * 3, E * kJoints * 3, G * 3,
        M * W, condition_count(s) * W, W, H * W * W, H * W, W * s.latent, s.latent, s.has_grid ? G * 4 : 0,
        s.has_heads ? G * s.latent * kOffsets : 0, s.has_heads ? G * kOffsets : 0, G * 4, G * 3, G, G * s.coefficients * 3,
        s.has_skull_binding ? G : 0};
    std::copy(values, values + kArrays, lengths);
}

WebAvatar::WebAvatar(const Sizes& s) : sizes_(s) {
    const std::int64_t V = s.vertices, G = s.gaussians, M = s.nodes, W = s.width;
    std::int64_t lengths[kArrays];
    array_lengths(s, lengths);
    for (int which = 0; which < kArrays; ++which) arrays_[which].resize(lengths[which]);
    corners_.resize(G * 3);
    cells_.resize(s.has_grid ? G * 4 : 0);
    parameters_.resize(parameter_count(s));
    shape_.resize(V * 3);
    posed_.resize(V * 3);
    points_.resize(G * 3);
    layer_.resize(M * W);
    next_layer_.resize(M * W);
    block_.resize(2 * kLanes * W);
    latents_.resize(M * s.latent);
    own_latents_.resize(s.has_grid ? G * s.latent : 0);
    raw_.resize(s.has_heads ? G * kOffsets : 0);
    means_.resize(G * 3);
    quats_.resize(G * 4);
    scales_.resize(G * 3);
    opacities_.resize(G);
}

float* WebAvatar::array(int which) { return which >= 0 && which < kArrays ? arrays_[which].data() : nullptr; }

bool WebAvatar::is_sound() const {
    const auto within = [](const std::vector<std::int32_t>& values, std::int32_t limit) {
        return std::all_of(values.begin(), values.end(), [=](std::int32_t v) { return v >= 0 && v < limit; });
    };
    for (int joint = 1; joint < kJoints; ++joint)
        if (parents[joint] < 0 || parents[joint] >= joint) return false;
    return within(corners_, sizes_.vertices) && within(cells_, sizes_.nodes);
}

void WebAvatar::pose() {
    skin();
    evaluate_network();
    offset();
}

// Linear blend skinning as in avatar/head/model.py, then the points of the Gaussians on the mesh.
void WebAvatar::skin() {
    const std::int64_t V = sizes_.vertices, G = sizes_.gaussians;
    const int E = sizes_.expressions;
    const float *expression = parameters_.data(), *jaw = expression + E, *eyes = jaw + kJaw, *eyelids = eyes + kEyes,
                *neck = eyelids + kEyelids;
    shape_ = arrays_[kShape];
    float joints[kJoints * 3];
    std::copy(arrays_[kJointsAtRest].begin(), arrays_[kJointsAtRest].end(), joints);
    for (int e = 0; e < E; ++e) {
        if (expression[e] == 0.0f) continue;
        add_scaled(shape_, arrays_[kExpressionDirs].data() + e * V * 3, expression[e]);
        for (int i = 0; i < kJoints * 3; ++i) joints[i] += expression[e] * arrays_[kExpressionJoints][e * kJoints * 3 + i];
    }
    // Most of a pose's correctives are zero: joints that do not turn.
    const Rotation own[kJoints] = {{{1, 0, 0, 0, 1, 0, 0, 0, 1}}, rotation_from_6d(neck), rotation_from_6d(jaw),
                                   rotation_from_6d(eyes), rotation_from_6d(eyes + 6)};
    for (int joint = 1; joint < kJoints; ++joint)
        for (int i = 0; i < 9; ++i) {
            const float away = own[joint].m[i] - own[0].m[i];
            if (away != 0.0f) add_scaled(shape_, arrays_[kPoseDirs].data() + ((joint - 1) * 9 + i) * V * 3, away);
        }
    // The head stays where the camera expects it: the root turns backwards about the neck's joint at rest.
    const float* pivot = arrays_[kJointsAtRest].data() + 3 * kNeckJoint;
    Rotation R[kJoints];
    float t[kJoints][3];
    for (int joint = 0; joint < kJoints; ++joint) {
        const int parent = parents[joint];
        R[joint] = joint == 0 ? transposed(own[kNeckJoint]) : product(R[parent], own[joint]);
        const float* at = joint == 0 ? pivot : joints + 3 * joint;
        for (int i = 0; i < 3; ++i) {
            float to = joint == 0 ? pivot[i] : t[parent][i], turned = 0;
            for (int k = 0; k < 3; ++k) {
                if (joint != 0) to += R[parent].m[3 * i + k] * at[k];
                turned += R[joint].m[3 * i + k] * at[k];
            }
            t[joint][i] = to - turned;
        }
    }
    const float *weights = arrays_[kWeights].data(), *lids = arrays_[kEyelidDirs].data();
    for (std::int64_t v = 0; v < V; ++v) {
        float blended[9] = {}, shift[3] = {};
        for (int joint = 0; joint < kJoints; ++joint) {
            const float w = weights[v * kJoints + joint];
            for (int i = 0; i < 9; ++i) blended[i] += w * R[joint].m[i];
            for (int i = 0; i < 3; ++i) shift[i] += w * t[joint][i];
        }
        const float* from = shape_.data() + 3 * v;
        for (int i = 0; i < 3; ++i)
            posed_[3 * v + i] = blended[3 * i] * from[0] + blended[3 * i + 1] * from[1] + blended[3 * i + 2] * from[2] +
                                shift[i] + eyelids[0] * lids[3 * v + i] + eyelids[1] * lids[3 * (V + v) + i];
    }
    const float* barycentric = arrays_[kBarycentric].data();
    for (std::int64_t g = 0; g < G; ++g)
        for (int i = 0; i < 3; ++i) {
            float sum = 0;
            for (int k = 0; k < 3; ++k) sum += barycentric[3 * g + k] * posed_[3 * corners_[3 * g + k] + i];
            points_[3 * g + i] = sum;
        }
    if (sizes_.has_skull_binding) bind_to_skull(R[0]);
}

// Brings the points to the skull by their shares, as avatar/gaussians/skull_binding.py. `turn` is the torso's.
void WebAvatar::bind_to_skull(const Rotation& turn) {
    bool carried[kJoints] = {};
    for (int joint = kNeckJoint; joint < kJoints; ++joint)
        carried[joint] = joint == kNeckJoint || (parents[joint] >= 0 && carried[parents[joint]]);
    const float *barycentric = arrays_[kBarycentric].data(), *shape = arrays_[kShape].data(),
                *weights = arrays_[kWeights].data(), *pivot = arrays_[kJointsAtRest].data() + 3 * kNeckJoint;
    for (std::int64_t g = 0; g < sizes_.gaussians; ++g) {
        float at_rest[3] = {}, arm[3] = {};
        for (int k = 0; k < 3; ++k) {
            const float b = barycentric[3 * g + k];
            const std::int64_t v = corners_[3 * g + k];
            float share = 0;
            for (int joint = 0; joint < kJoints; ++joint)
                if (carried[joint]) share += weights[v * kJoints + joint];
            for (int i = 0; i < 3; ++i) {
                at_rest[i] += b * shape[3 * v + i];
                arm[i] += b * (1 - share) * (shape[3 * v + i] - pivot[i]);
            }
        }
        const float share = arrays_[kSkullShare][g];
        for (int i = 0; i < 3; ++i) {
            float on_skull = at_rest[i];
            for (int k = 0; k < 3; ++k)
                on_skull += (turn.m[3 * i + k] - (i == k ? 1.0f : 0.0f)) * arm[k];
            points_[3 * g + i] += share * (on_skull - points_[3 * g + i]);
        }
    }
}

// As FoldedNetwork in avatar/render.py.
void WebAvatar::evaluate_network() {
    const int M = sizes_.nodes, W = sizes_.width, C = moving_count(sizes_);
    std::vector<float> of_frame = arrays_[kInputBias];
    const float* weights = arrays_[kForCondition].data();
    for (int c = 0; c < C; ++c)
        if (parameters_[c] != 0.0f) add_scaled(of_frame, weights + std::int64_t{c} * W, parameters_[c]);
    for (int c = C; c < condition_count(sizes_); ++c) add_scaled(of_frame, weights + std::int64_t{c} * W, head_rotation[c - C]);
    const float* of_code = arrays_[kOfCode].data();
    for (std::int64_t m = 0; m < M; ++m)
        for (int j = 0; j < W; ++j) layer_[m * W + j] = std::max(of_code[m * W + j] + of_frame[j], 0.0f);
    for (int h = 0; h + 1 < sizes_.layers; ++h) {
        layer<true>(layer_.data(), arrays_[kHiddenWeights].data() + std::int64_t{h} * W * W,
                    arrays_[kHiddenBiases].data() + std::int64_t{h} * W, M, W, W, block_.data(), next_layer_.data());
        layer_.swap(next_layer_);
    }
    layer<false>(layer_.data(), arrays_[kOutputWeights].data(), arrays_[kOutputBias].data(), M, W, sizes_.latent,
                 block_.data(), latents_.data());
}

void WebAvatar::offset() {
    const std::int64_t G = sizes_.gaussians, n = sizes_.latent;
    const hyper::Kernels& kernels = hyper::select_kernels("");
    const float* latents = latents_.data();
    if (sizes_.has_grid) {
        const hyper::Corners corners{cells_.data(), arrays_[kGridWeights].data()};
        kernels.interpolate(corners, latents, n, 0, G, own_latents_.data());
        latents = own_latents_.data();
    }
    const float* raw = latents;
    if (sizes_.has_heads) {
        kernels.apply(arrays_[kHeadMatrix].data(), arrays_[kHeadBias].data(), latents, n, 0, G, raw_.data());
        raw = raw_.data();
    }
    const apply_offsets::Parameters from{points_.data(), arrays_[kQuats].data(), arrays_[kLogScales].data(),
                                   arrays_[kOpacityLogits].data(), raw};
    apply_offsets::select_kernels("").forward(from, 0, G, {means_.data(), quats_.data(), scales_.data(), opacities_.data()});
}

bool WebAvatar::draw(const splat::Camera& camera, const float background[3], std::uint8_t* rgba) {
    const std::int64_t pixels = std::int64_t{camera.width} * camera.height;
    image_.resize(pixels * 3);
    alpha_.resize(pixels);
    const splat::Gaussians gaussians{means_.data(),     quats_.data(),         scales_.data(),     opacities_.data(),
                                     arrays_[kSh].data(), sizes_.gaussians, sizes_.coefficients};
    int degree = 0;
    while ((degree + 2) * (degree + 2) <= sizes_.coefficients) ++degree;
    const splat::Settings settings{degree, 1.0f / 255.0f, 0.999f, 1e-4f, blur, 0.01, false, false};
    if (!splat::forward(gaussians, camera, settings, {0, 0, camera.width, camera.height}, background,
                        splat::select_kernels(""), 1, image_.data(), alpha_.data()))
        return false;
    for (std::int64_t p = 0; p < pixels; ++p) {
        for (int c = 0; c < 3; ++c)
            rgba[4 * p + c] = static_cast<std::uint8_t>(std::min(std::max(image_[3 * p + c], 0.0f), 1.0f) * 255.0f + 0.5f);
        rgba[4 * p + 3] = 255;
    }
    return true;
}

}  // namespace avatar::web
