#pragma once
// Activations of vectors of floats, within 2 units in the last place over the whole range; NaN stays NaN. Included only by
// the kernels, as simd.h, whose min and max return their second argument where one is NaN.
#include "simd.h"

namespace {

inline Floats select(Ints condition, Floats yes, Floats no) { return condition ? yes : no; }
inline Floats magnitude(Floats x) { return (Floats)((Ints)x & ~sign_bits()); }

inline Floats square_root(Floats x) {
#if defined(__AVX512F__)
    return (Floats)_mm512_sqrt_ps((__m512)x);
#elif defined(__AVX2__)
    return (Floats)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE2__)
    return (Floats)_mm_sqrt_ps((__m128)x);
#elif defined(__aarch64__)
    return (Floats)vsqrtq_f32((float32x4_t)x);
#else
    for (int i = 0; i < kLanes; ++i) x[i] = __builtin_sqrtf(x[i]);
    return x;
#endif
}

// 2^n e^f with |f| <= ln(2) / 2; the constants are those of expf in the Cephes library.
inline Floats exponential(Floats x) {
    const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
    x = min(broadcast(89.0f), max(broadcast(-104.0f), x));  // beyond them: infinity and 0
    const Floats shifted = fma(x, broadcast(1.44269504f), magic);
    const Floats n = shifted - magic;
    Floats f = fma(n, broadcast(-0.693359375f), x);
    f = fma(n, broadcast(2.12194440e-4f), f);
    Floats p = broadcast(1.9875691500e-4f);
    p = fma(p, f, broadcast(1.3981999507e-3f));
    p = fma(p, f, broadcast(8.3334519073e-3f));
    p = fma(p, f, broadcast(4.1665795894e-2f));
    p = fma(p, f, broadcast(1.6666665459e-1f));
    p = fma(p, f, broadcast(5.0000001201e-1f));
    p = fma(p, f * f, f) + 1.0f;
    // In two factors: 2^128 and 2^-150 are no floats, the product may be.
    const Ints exponent = (Ints)shifted - (Ints)magic, half = exponent >> 1;
    return p * (Floats)((half + 127) << 23) * (Floats)((exponent - half + 127) << 23);
}

// The polynomial is that of tanhf in the Cephes library.
inline Floats hyperbolic_tangent(Floats x) {
    const Floats size = magnitude(x), z = x * x;
    Floats p = broadcast(-5.70498872745e-3f);
    p = fma(p, z, broadcast(2.06390887954e-2f));
    p = fma(p, z, broadcast(-5.37397155531e-2f));
    p = fma(p, z, broadcast(1.33314422036e-1f));
    p = fma(p, z, broadcast(-3.33332819422e-1f));
    const Floats near_zero = fma(p * z, x, x);
    const Floats far = 1.0f - 2.0f / (exponential(size + size) + 1.0f);
    return select(size < 0.625f, near_zero, (Floats)((Ints)far | ((Ints)x & sign_bits())));
}

inline Floats sigmoid(Floats x) {
    const Floats e = exponential((Floats)((Ints)x | sign_bits()));
    return select(x < 0.0f, e, broadcast(1.0f)) / (1.0f + e);
}

}  // namespace
