#pragma once
// Real spherical harmonics of degree 0 to 3 and their derivatives; the same functions, order and signs as
// avatar/splat/sh.py, which states the source. Included only by the kernels.
#include "simd.h"

namespace avatar::splat {
namespace {

constexpr int kMaxCoefficients = 16;

inline void sh_basis(int degree, const Floats d[3], Floats basis[kMaxCoefficients]) {
    const Floats x = d[0], y = d[1], z = d[2];
    basis[0] = broadcast(0.28209479177387814f);
    if (degree < 1) return;
    constexpr float c1 = 0.4886025119029199f;
    basis[1] = -c1 * y;
    basis[2] = c1 * z;
    basis[3] = -c1 * x;
    if (degree < 2) return;
    constexpr float c2 = 1.0925484305920792f, c20 = 0.31539156525252005f;
    const Floats xx = x * x, yy = y * y, zz = z * z;
    basis[4] = c2 * x * y;
    basis[5] = -c2 * y * z;
    basis[6] = c20 * (2.0f * zz - xx - yy);
    basis[7] = -c2 * x * z;
    basis[8] = 0.5f * c2 * (xx - yy);
    if (degree < 3) return;
    constexpr float c33 = 0.5900435899266435f, c32 = 2.890611442640554f, c31 = 0.4570457994644658f,
                    c30 = 0.3731763325901154f;
    basis[9] = -c33 * y * (3.0f * xx - yy);
    basis[10] = c32 * x * y * z;
    basis[11] = -c31 * y * (4.0f * zz - xx - yy);
    basis[12] = c30 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    basis[13] = -c31 * x * (4.0f * zz - xx - yy);
    basis[14] = 0.5f * c32 * z * (xx - yy);
    basis[15] = -c33 * x * (xx - 3.0f * yy);
}

// gradient[j] += sum over k of g[k] * d basis[k] / d direction[j], the direction's three components taken as
// independent.
inline void sh_basis_backward(int degree, const Floats d[3], const Floats g[kMaxCoefficients], Floats gradient[3]) {
    const Floats x = d[0], y = d[1], z = d[2];
    if (degree < 1) return;
    constexpr float c1 = 0.4886025119029199f;
    gradient[0] -= c1 * g[3];
    gradient[1] -= c1 * g[1];
    gradient[2] += c1 * g[2];
    if (degree < 2) return;
    constexpr float c2 = 1.0925484305920792f, c20 = 0.31539156525252005f;
    gradient[0] += c2 * (y * g[4] - z * g[7] + x * g[8]) - 2 * c20 * x * g[6];
    gradient[1] += c2 * (x * g[4] - z * g[5] - y * g[8]) - 2 * c20 * y * g[6];
    gradient[2] += 4 * c20 * z * g[6] - c2 * (y * g[5] + x * g[7]);
    if (degree < 3) return;
    constexpr float c33 = 0.5900435899266435f, c32 = 2.890611442640554f, c31 = 0.4570457994644658f,
                    c30 = 0.3731763325901154f;
    const Floats xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    gradient[0] += -6 * c33 * xy * g[9] + c32 * yz * g[10] + 2 * c31 * xy * g[11] - 6 * c30 * xz * g[12] -
                   c31 * (4.0f * zz - 3.0f * xx - yy) * g[13] + c32 * xz * g[14] - 3 * c33 * (xx - yy) * g[15];
    gradient[1] += -3 * c33 * (xx - yy) * g[9] + c32 * xz * g[10] - c31 * (4.0f * zz - xx - 3.0f * yy) * g[11] -
                   6 * c30 * yz * g[12] + 2 * c31 * xy * g[13] - c32 * yz * g[14] + 6 * c33 * xy * g[15];
    gradient[2] += c32 * xy * g[10] - 8 * c31 * yz * g[11] + 3 * c30 * (2.0f * zz - xx - yy) * g[12] -
                   8 * c31 * xz * g[13] + 0.5f * c32 * (xx - yy) * g[14];
}

}  // namespace
}  // namespace avatar::splat
