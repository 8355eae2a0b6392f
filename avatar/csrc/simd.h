#pragma once
// Vectors of floats as wide as the target of this compilation, through the vector extensions of GCC and Clang. Included
// only by the kernels, which are compiled once for each instruction set: everything here has internal linkage, and no
// standard-library template may be used beside it, or code for one set could be linked into another.
#if defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif
#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Floats __attribute__((vector_size(kLanes * sizeof(float))));
typedef int Ints __attribute__((vector_size(kLanes * sizeof(int))));

inline Floats load(const float* p) { return *reinterpret_cast<const Floats*>(p); }  // p aligned
inline Ints load(const int* p) { return *reinterpret_cast<const Ints*>(p); }        // p aligned
inline void store(int* p, Ints v) { *reinterpret_cast<Ints*>(p) = v; }            // p aligned
inline void store(float* p, Floats v) { *reinterpret_cast<Floats*>(p) = v; }        // p aligned
inline Floats broadcast(float x) { return x - Floats{}; }
inline Ints sign_bits() { return Ints{} - 0x7fffffff - 1; }

typedef Floats FloatsAnywhere __attribute__((aligned(alignof(float)), may_alias));

inline Floats load_anywhere(const float* p) { return *reinterpret_cast<const FloatsAnywhere*>(p); }
inline void store_anywhere(float* p, Floats v) { *reinterpret_cast<FloatsAnywhere*>(p) = v; }

// p aligned to the vector, where it is as wide as a line of the caches. Who writes so calls finish_stores_past_caches()
// before another thread may look.
inline void store_past_caches(float* p, Floats v) {
#if defined(__AVX512F__)
    _mm512_stream_ps(p, (__m512)v);
#else
    store_anywhere(p, v);
#endif
}
inline void finish_stores_past_caches() {
#if defined(__AVX512F__)
    _mm_sfence();
#endif
}

// GCC makes a constant of a vector that is filled so, Clang only if it is told to.
#if defined(__clang__)
#define AVATAR_FOR_EACH_LANE(i) _Pragma("clang loop unroll(full)") for (int i = 0; i < kLanes; ++i)
#else
#define AVATAR_FOR_EACH_LANE(i) for (int i = 0; i < kLanes; ++i)
#endif

// 0, 1, 2 ... modulo n, and divided by n without a rest.
inline Floats remainders(int n) {
    Floats v{};
    AVATAR_FOR_EACH_LANE(i) v[i] = float(i % n);
    return v;
}
inline Floats quotients(int n) {
    Floats v{};
    AVATAR_FOR_EACH_LANE(i) v[i] = float(i / n);
    return v;
}

// a * b + c. Explicit, with contraction off in the kernels, so that forward and backward round alike.
inline Floats fma(Floats a, Floats b, Floats c) {
#if defined(__AVX512F__)
    return (Floats)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif defined(__FMA__)
    return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#elif defined(__aarch64__)
    return (Floats)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#else
    return a * b + c;
#endif
}

// GCC makes one instruction of the comparison for AVX-512 (and warns of its own header's _mm512_min_ps), not for the
// others.
inline Floats min(Floats a, Floats b) {
#if defined(__AVX512F__)
    return a < b ? a : b;
#elif defined(__AVX2__)
    return (Floats)_mm256_min_ps((__m256)a, (__m256)b);
#elif defined(__wasm_simd128__)  // its own: Emscripten's _mm_min_ps takes three instructions
    return (Floats)wasm_f32x4_pmin((v128_t)b, (v128_t)a);
#elif defined(__SSE2__)
    return (Floats)_mm_min_ps((__m128)a, (__m128)b);
#else
    return a < b ? a : b;
#endif
}

inline Floats max(Floats a, Floats b) {
#if defined(__AVX512F__)
    return a > b ? a : b;
#elif defined(__AVX2__)
    return (Floats)_mm256_max_ps((__m256)a, (__m256)b);
#elif defined(__wasm_simd128__)
    return (Floats)wasm_f32x4_pmax((v128_t)b, (v128_t)a);
#elif defined(__SSE2__)
    return (Floats)_mm_max_ps((__m128)a, (__m128)b);
#else
    return a > b ? a : b;
#endif
}

// Bit i is the sign bit of lane i.
inline unsigned signs(Ints v) {
#if defined(__AVX512F__)
    return _mm512_movepi32_mask((__m512i)v);
#elif defined(__AVX2__)
    return static_cast<unsigned>(_mm256_movemask_ps((__m256)v));
#elif defined(__SSE2__)
    return static_cast<unsigned>(_mm_movemask_ps((__m128)v));
#else
    unsigned bits = 0;
    for (int i = 0; i < kLanes; ++i) bits |= (static_cast<unsigned>(v[i]) >> 31) << i;
    return bits;
#endif
}

constexpr unsigned kAllLanes = (1u << kLanes) - 1;

// The sums of the lanes of four vectors. In few instructions: the backward pass takes nine for each splat in a tile.
typedef float Four __attribute__((vector_size(16)));

#if defined(__SSE2__)
inline Four quarter(Floats v) {
#if defined(__AVX512F__)
    // With a mask because GCC warns of its own header's other form.
    const __m256 low = _mm512_maskz_extractf32x8_ps(0xff, (__m512)v, 0);
    const __m256 high = _mm512_maskz_extractf32x8_ps(0xff, (__m512)v, 1);
    const __m256 half = _mm256_add_ps(low, high);
    return (Four)_mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
#elif defined(__AVX2__)
    return (Four)_mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
#else
    return v;
#endif
}

inline Four sums(Floats v0, Floats v1, Floats v2, Floats v3) {
    const __m128 a = (__m128)quarter(v0), b = (__m128)quarter(v1), c = (__m128)quarter(v2), d = (__m128)quarter(v3);
    const __m128 ab = _mm_add_ps(_mm_unpacklo_ps(a, b), _mm_unpackhi_ps(a, b));
    const __m128 cd = _mm_add_ps(_mm_unpacklo_ps(c, d), _mm_unpackhi_ps(c, d));
    return (Four)_mm_add_ps(_mm_movelh_ps(ab, cd), _mm_movehl_ps(cd, ab));
}
#else
inline Four sums(Floats v0, Floats v1, Floats v2, Floats v3) {
    Four result{};
    for (int i = 0; i < kLanes; ++i) result += Four{v0[i], v1[i], v2[i], v3[i]};
    return result;
}
#endif

// 2^x for x <= 0: relative error below 1.6e-7 down to x = -126, exactly 1 at 0 and exactly 0 from -127 on. The
// polynomial has the least largest relative error to 2^f on [-1/2, 1/2] (9.2e-8, before rounding) among those of degree
// 5 with constant term 1.
inline Floats exp2_negative(Floats x) {
    const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
    x = max(x, broadcast(-127.0f));
    const Floats shifted = x + magic;
    const Floats f = x - (shifted - magic);
    Floats p = broadcast(1.326470869e-3f);
    p = fma(p, f, broadcast(9.671511129e-3f));
    p = fma(p, f, broadcast(5.550733954e-2f));
    p = fma(p, f, broadcast(2.402224243e-1f));
    p = fma(p, f, broadcast(6.931470037e-1f));
    p = fma(p, f, broadcast(1.0f));
    return (Floats)((Ints)p + ((Ints)shifted << 23));
}

}  // namespace
