#pragma once
#include <cstdint>
#include <cstring>

namespace avatar::hyper {
namespace {

// e^x in a form that loops over it are vectorised: relative error below 2e-7 where the result is a normal number, 0 below
// x = -104, infinite from 89 on, NaN of NaN. x = k ln 2 + r with k whole and |r| <= ln 2 / 2, and the Taylor polynomial
// of degree 7 in r, whose remainder is below 6e-9.
inline float exponential(float x) {
    x = x < -104.0f ? -104.0f : x;  // false for NaN, which stays
    x = x > 89.0f ? 89.0f : x;
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to the nearest whole number
    const float shifted = x * 1.44269504f + magic, k = shifted - magic;
    const float r = (x - k * 0.693359375f) + k * 2.12194440e-4f;  // the first product is exact
    float p = 1.0f / 5040;
    p = p * r + 1.0f / 720;
    p = p * r + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    std::uint32_t bits, zero;
    std::memcpy(&bits, &shifted, sizeof bits);
    std::memcpy(&zero, &magic, sizeof zero);
    // 2^k is no float for the outermost k, so it is multiplied in two parts; 256 keeps the halving to whole numbers >= 0.
    const std::uint32_t biased = bits - zero + 256, half = biased / 2;
    const std::uint32_t low = (half - 128 + 127) << 23, high = (biased - half - 128 + 127) << 23;
    float a, b;
    std::memcpy(&a, &low, sizeof a);
    std::memcpy(&b, &high, sizeof b);
    return p * a * b;
}

}  // namespace
}  // namespace avatar::hyper
