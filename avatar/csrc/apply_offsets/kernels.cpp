// Compiled once for each instruction set; AVATAR_KERNELS says which.
#include "apply_offsets/activations.h"
#include "apply_offsets/apply_offsets.h"

namespace avatar::apply_offsets {
namespace {

constexpr int kBlock = 64;  // Gaussians whose values lie side by side, one array a component, while they are worked on
constexpr int kOffsets = 10;
constexpr float kSmallestNorm = 1e-12f;  // of torch.nn.functional.normalize

template <int components>
struct alignas(64) Block {
    float values[components][kBlock];

    Floats at(int component, int i) const { return load(values[component] + i); }
    void put(int component, int i, Floats v) { store(values[component] + i, v); }

    // Values beyond `count` become 1: something that every formula here can take.
    void read(const float* rows, std::int64_t begin, int count) {
        rows += begin * components;
        for (int i = 0; i < kBlock; ++i)
            for (int c = 0; c < components; ++c) values[c][i] = i < count ? rows[i * components + c] : 1.0f;
    }
    void write(float* rows, std::int64_t begin, int count) const {
        rows += begin * components;
        for (int i = 0; i < count; ++i)
            for (int c = 0; c < components; ++c) rows[i * components + c] = values[c][i];
    }
};

struct Quaternion {
    Floats w, x, y, z;
};

inline Quaternion product(const Quaternion& a, const Quaternion& b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
inline Quaternion conjugate(const Quaternion& q) { return {q.w, -q.x, -q.y, -q.z}; }
inline Quaternion times(const Quaternion& q, Floats s) { return {q.w * s, q.x * s, q.y * s, q.z * s}; }
inline Floats dot(const Quaternion& a, const Quaternion& b) {
    return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z;
}
inline Quaternion quaternion(const Block<4>& block, int i) {
    return {block.at(0, i), block.at(1, i), block.at(2, i), block.at(3, i)};
}
inline void put(Block<4>& block, int i, const Quaternion& q) {
    block.put(0, i, q.w);
    block.put(1, i, q.x);
    block.put(2, i, q.y);
    block.put(3, i, q.z);
}

// A quaternion divided by max(norm, kSmallestNorm).
struct Normalized {
    Quaternion unit;
    Floats norm, inverse;
};

inline Normalized normalize(const Quaternion& q) {
    const Floats norm = square_root(dot(q, q));
    const Floats inverse = 1.0f / max(broadcast(kSmallestNorm), norm);
    return {times(q, inverse), norm, inverse};
}

inline Quaternion normalize_backward(const Normalized& of, const Quaternion& grad) {
    const Floats along = select(of.norm < kSmallestNorm, Floats{}, dot(of.unit, grad));
    const Quaternion& q = of.unit;
    return times({grad.w - q.w * along, grad.x - q.x * along, grad.y - q.y * along, grad.z - q.z * along},
                 of.inverse);
}

struct Offsets {
    Floats position[3], rotation[4], scale[3];
    Quaternion delta() const { return {exponential(rotation[0]), rotation[1], rotation[2], rotation[3]}; }
};

inline Offsets offsets(const Block<kOffsets>& raw, int i) {
    Offsets o;
    for (int c = 0; c < 3; ++c) o.position[c] = hyperbolic_tangent(raw.at(c, i));
    for (int c = 0; c < 4; ++c) o.rotation[c] = hyperbolic_tangent(raw.at(3 + c, i));
    for (int c = 0; c < 3; ++c) o.scale[c] = hyperbolic_tangent(raw.at(7 + c, i));
    return o;
}

void forward_block(const Parameters& from, std::int64_t begin, int count, const Activated& to) {
    Block<kOffsets> raw;
    Block<3> points, log_scales;
    Block<4> quats;
    Block<1> logits;
    raw.read(from.raw, begin, count);
    points.read(from.points, begin, count);
    quats.read(from.quats, begin, count);
    log_scales.read(from.log_scales, begin, count);
    logits.read(from.opacity_logits, begin, count);
    for (int i = 0; i < count; i += kLanes) {
        const Offsets o = offsets(raw, i);
        for (int c = 0; c < 3; ++c) {
            points.put(c, i, points.at(c, i) + o.position[c]);
            log_scales.put(c, i, exponential(log_scales.at(c, i) * exponential(o.scale[c])));
        }
        put(quats, i, normalize(product(normalize(quaternion(quats, i)).unit, o.delta())).unit);
        logits.put(0, i, sigmoid(logits.at(0, i)));
    }
    points.write(to.means, begin, count);
    quats.write(to.quats, begin, count);
    log_scales.write(to.scales, begin, count);
    logits.write(to.opacities, begin, count);
}

void backward_block(const Parameters& from, const Upstream& upstream, std::int64_t begin, int count,
                    const Gradients& to) {
    Block<kOffsets> raw;
    Block<3> log_scales, means_grad, scales, scales_grad;
    Block<4> quats, quats_grad;
    Block<1> opacities, opacities_grad;
    raw.read(from.raw, begin, count);
    quats.read(from.quats, begin, count);
    log_scales.read(from.log_scales, begin, count);
    means_grad.read(upstream.means, begin, count);
    quats_grad.read(upstream.quats, begin, count);
    scales_grad.read(upstream.scales, begin, count);
    opacities_grad.read(upstream.opacities, begin, count);
    scales.read(upstream.activated_scales, begin, count);
    opacities.read(upstream.activated_opacities, begin, count);
    // Each gradient takes the place of what it is the gradient of, or came from.
    for (int i = 0; i < count; i += kLanes) {
        const Offsets o = offsets(raw, i);
        Floats by_offset[kOffsets];
        for (int c = 0; c < 3; ++c) by_offset[c] = means_grad.at(c, i);

        const Normalized base = normalize(quaternion(quats, i));
        const Quaternion delta = o.delta();
        const Normalized turned = normalize(product(base.unit, delta));
        const Quaternion by_product = normalize_backward(turned, quaternion(quats_grad, i));
        const Quaternion by_delta = product(conjugate(base.unit), by_product);
        put(quats, i, normalize_backward(base, product(by_product, conjugate(delta))));
        by_offset[3] = by_delta.w * delta.w;
        by_offset[4] = by_delta.x;
        by_offset[5] = by_delta.y;
        by_offset[6] = by_delta.z;

        for (int c = 0; c < 3; ++c) {
            const Floats factor = exponential(o.scale[c]), log_scale = log_scales.at(c, i);
            const Floats by_log = scales_grad.at(c, i) * scales.at(c, i) * factor;
            by_offset[7 + c] = by_log * log_scale;
            log_scales.put(c, i, by_log);
        }
        const Floats opacity = opacities.at(0, i);
        opacities.put(0, i, opacities_grad.at(0, i) * (1.0f - opacity) * opacity);

        const Floats* const bounded[3] = {o.position, o.rotation, o.scale};
        constexpr int first[4] = {0, 3, 7, kOffsets};
        for (int part = 0; part < 3; ++part)
            for (int c = first[part]; c < first[part + 1]; ++c) {
                const Floats t = bounded[part][c - first[part]];
                raw.put(c, i, by_offset[c] * ((1.0f - t) * (1.0f + t)));
            }
    }
    raw.write(to.raw, begin, count);
    quats.write(to.quats, begin, count);
    log_scales.write(to.log_scales, begin, count);
    opacities.write(to.opacity_logits, begin, count);
}

inline int size_of_block(std::int64_t begin, std::int64_t end) {
    return end - begin < kBlock ? static_cast<int>(end - begin) : kBlock;
}

void forward(const Parameters& from, std::int64_t begin, std::int64_t end, const Activated& to) {
    for (; begin < end; begin += kBlock) forward_block(from, begin, size_of_block(begin, end), to);
}

void backward(const Parameters& from, const Upstream& upstream, std::int64_t begin, std::int64_t end,
              const Gradients& to) {
    for (; begin < end; begin += kBlock) backward_block(from, upstream, begin, size_of_block(begin, end), to);
}

}  // namespace

extern const Kernels AVATAR_KERNELS;
const Kernels AVATAR_KERNELS = {forward, backward};

}  // namespace avatar::apply_offsets
