#pragma once
#include "simd.h"

namespace avatar::hyper {
namespace {

// e^x: relative error below 2e-7 where the result is a normal number, 0 below x = -104, infinite from 89 on, NaN of NaN.
// x = k ln 2 + r with k whole and |r| <= ln 2 / 2, and the Taylor polynomial of degree 7 in r, whose remainder is below
// 6e-9. Every product and sum is rounded by itself, so the bits are the same for any width of a vector.
inline Floats exponential(Floats x) {
    x = x < -104.0f ? broadcast(-104.0f) : x;  // false for NaN, which stays
    x = x > 89.0f ? broadcast(89.0f) : x;
    const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest whole number
    const Floats shifted = x * 1.44269504f + magic, k = shifted - magic;
    const Floats r = (x - k * 0.693359375f) + k * 2.12194440e-4f;  // the first product is exact
    Floats p = broadcast(1.0f / 5040);
    p = p * r + 1.0f / 720;
    p = p * r + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    // 2^k is no float for the outermost k, so it is multiplied in two parts; 256 keeps the halving to whole numbers >= 0.
    const Ints biased = (Ints)shifted - (Ints)magic + 256, half = biased >> 1;
    return p * (Floats)((half - 1) << 23) * (Floats)((biased - half - 1) << 23);
}

}  // namespace
}  // namespace avatar::hyper
