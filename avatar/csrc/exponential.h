#pragma once
// Exponentials of vectors, all by one plan: the exponent's whole part goes into the result's bits, a polynomial takes the
// rest. They differ in range, in error and in whether products and sums are fused, so no two give the same bits.
// Included only by the kernels, as simd.h.
#include "simd.h"

namespace {

// Adding it to a number of magnitude below 2^22 rounds that to the nearest whole number, which stands in the last bits
// of the sum; taking it off again leaves the whole number.
constexpr float kRounder = 12582912.0f;  // 1.5 * 2^23

// p 2^k for whole k = rounded - kRounder from -150 to 128. In two factors: 2^128 and 2^-150 are no floats, the product
// may be one.
inline Floats times_power_of_two(Floats p, Floats rounded) {
    const Ints k = (Ints)rounded - (Ints)broadcast(kRounder), half = k >> 1;
    return p * (Floats)((half + 127) << 23) * (Floats)((k - half + 127) << 23);
}

// 2^x for x <= 0: relative error below 1.6e-7 down to x = -126, exactly 1 at 0 and exactly 0 from -127 on. The
// polynomial has the least largest relative error to 2^f on [-1/2, 1/2] (9.2e-8, before rounding) among those of degree
// 5 with constant term 1.
inline Floats exp2_negative(Floats x) {
    x = max(x, broadcast(-127.0f));
    const Floats shifted = x + kRounder;
    const Floats f = x - (shifted - kRounder);
    Floats p = broadcast(1.326470869e-3f);
    p = fma(p, f, broadcast(9.671511129e-3f));
    p = fma(p, f, broadcast(5.550733954e-2f));
    p = fma(p, f, broadcast(2.402224243e-1f));
    p = fma(p, f, broadcast(6.931470037e-1f));
    p = fma(p, f, broadcast(1.0f));
    return (Floats)((Ints)p + ((Ints)shifted << 23));
}

// e^x = 2^n e^f with |f| <= ln(2) / 2, within 2 units in the last place; NaN of NaN. The constants are those of expf in
// the Cephes library.
inline Floats exponential(Floats x) {
    x = min(broadcast(89.0f), max(broadcast(-104.0f), x));  // beyond them: infinity and 0; NaN stays
    const Floats shifted = fma(x, broadcast(1.44269504f), broadcast(kRounder));
    const Floats n = shifted - kRounder;
    Floats f = fma(n, broadcast(-0.693359375f), x);
    f = fma(n, broadcast(2.12194440e-4f), f);
    Floats p = broadcast(1.9875691500e-4f);
    p = fma(p, f, broadcast(1.3981999507e-3f));
    p = fma(p, f, broadcast(8.3334519073e-3f));
    p = fma(p, f, broadcast(4.1665795894e-2f));
    p = fma(p, f, broadcast(1.6666665459e-1f));
    p = fma(p, f, broadcast(5.0000001201e-1f));
    p = fma(p, f * f, f) + 1.0f;
    return times_power_of_two(p, shifted);
}

// The same with every product and sum rounded by itself, so that the bits are the same for any width of a vector:
// relative error below 2e-7 where the result is a normal number. The Taylor polynomial of degree 7, whose remainder is
// below 6e-9.
inline Floats exponential_unfused(Floats x) {
    x = x < -104.0f ? broadcast(-104.0f) : x;  // false for NaN, which stays
    x = x > 89.0f ? broadcast(89.0f) : x;
    const Floats shifted = x * 1.44269504f + kRounder, n = shifted - kRounder;
    const Floats f = (x - n * 0.693359375f) + n * 2.12194440e-4f;  // the first product is exact
    Floats p = broadcast(1.0f / 5040);
    p = p * f + 1.0f / 720;
    p = p * f + 1.0f / 120;
    p = p * f + 1.0f / 24;
    p = p * f + 1.0f / 6;
    p = p * f + 0.5f;
    p = p * f + 1.0f;
    p = p * f + 1.0f;
    return times_power_of_two(p, shifted);
}

}  // namespace
