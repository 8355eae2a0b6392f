#pragma once
// Four floats, which every instruction set has: an attribute has 3 or 4 values, and arithmetic that is the same everywhere
// gives the same bits everywhere. Included only by the kernels (internal linkage).
#include <cstring>

namespace avatar::hyper {
namespace {

constexpr int kStrip = 8;  // latent dimensions that are worked on together

typedef float Four __attribute__((vector_size(16)));

inline Four broadcast(float x) { return Four{x, x, x, x}; }

// The M values at p. With `room` a fourth may be touched even if M is 3: it must be there, and what a store leaves in it
// must be overwritten later.
template <int M>
inline Four load(const float* p, bool room) {
    Four v{};
    if (M == 4 || room)
        std::memcpy(&v, p, sizeof v);
    else
        for (int i = 0; i < M; ++i) v[i] = p[i];
    return v;
}

template <int M>
inline void store(float* p, Four v, bool room) {
    if (M == 4 || room)
        std::memcpy(p, &v, sizeof v);
    else
        for (int i = 0; i < M; ++i) p[i] = v[i];
}

}  // namespace
}  // namespace avatar::hyper
