#pragma once
// Activations of vectors of floats, within 2 units in the last place over the whole range; NaN stays NaN. Included only
// by the kernels, as simd.h.
#include "exponential.h"

namespace {

inline Floats select(Ints condition, Floats yes, Floats no) { return condition ? yes : no; }
inline Floats magnitude(Floats x) { return (Floats)((Ints)x & ~sign_bits()); }

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
