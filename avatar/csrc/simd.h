#pragma once
// Vectors of floats and of doubles as wide as the target of this compilation, through the vector extensions of GCC and
// Clang. Included only by the kernels, which are compiled once for each instruction set: everything here has internal
// linkage, and no standard-library template may be used beside it, or code for one set could be linked into another.
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

constexpr int kDoubles = kLanes / 2;

typedef float Floats __attribute__((vector_size(kLanes * sizeof(float))));
typedef int Ints __attribute__((vector_size(kLanes * sizeof(int))));
typedef double Doubles __attribute__((vector_size(kDoubles * sizeof(double))));
using Longs = decltype(Doubles{} < Doubles{});  // integers as wide as doubles; ones where a comparison holds

// Of memory that is aligned to the vector.
inline Floats load(const float* p) { return *reinterpret_cast<const Floats*>(p); }
inline Doubles load(const double* p) { return *reinterpret_cast<const Doubles*>(p); }
inline void store(float* p, Floats v) { *reinterpret_cast<Floats*>(p) = v; }
inline void store(double* p, Doubles v) { *reinterpret_cast<Doubles*>(p) = v; }
inline Floats broadcast(float x) { return x - Floats{}; }
inline Ints sign_bits() { return Ints{} - 0x7fffffff - 1; }

typedef Floats FloatsAnywhere __attribute__((aligned(alignof(float)), may_alias));
typedef Doubles DoublesAnywhere __attribute__((aligned(alignof(double)), may_alias));

inline Floats load_anywhere(const float* p) { return *reinterpret_cast<const FloatsAnywhere*>(p); }
inline Doubles load_anywhere(const double* p) { return *reinterpret_cast<const DoublesAnywhere*>(p); }
inline void store_anywhere(float* p, Floats v) { *reinterpret_cast<FloatsAnywhere*>(p) = v; }
inline void store_anywhere(double* p, Doubles v) { *reinterpret_cast<DoublesAnywhere*>(p) = v; }

// kDoubles floats in memory.
typedef float HalfFloats __attribute__((vector_size(kDoubles * sizeof(float))));

inline Doubles load_as_doubles(const float* p) {
    HalfFloats v;
    __builtin_memcpy(&v, p, sizeof v);
    return __builtin_convertvector(v, Doubles);
}
inline void store_as_floats(float* p, Doubles v) {
    const HalfFloats rounded = __builtin_convertvector(v, HalfFloats);
    __builtin_memcpy(p, &rounded, sizeof rounded);
}

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

// The second where one is NaN. With a mask of all lanes for AVX-512, because GCC warns of its own header's other form.
inline Floats min(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b);
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
    return (Floats)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b);
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

inline Floats square_root(Floats x) {
#if defined(__AVX512F__)
    return (Floats)_mm512_maskz_sqrt_ps(0xffff, (__m512)x);
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

inline Doubles square_root(Doubles x) {
#if defined(__AVX512F__)
    return (Doubles)_mm512_maskz_sqrt_pd(0xff, (__m512d)x);
#elif defined(__AVX2__)
    return (Doubles)_mm256_sqrt_pd((__m256d)x);
#elif defined(__SSE2__)
    return (Doubles)_mm_sqrt_pd((__m128d)x);
#elif defined(__aarch64__)
    return (Doubles)vsqrtq_f64((float64x2_t)x);
#else
    for (int i = 0; i < kDoubles; ++i) x[i] = __builtin_sqrt(x[i]);
    return x;
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

inline unsigned signs(Longs v) {
#if defined(__AVX512F__)
    return _mm512_movepi64_mask((__m512i)v);
#elif defined(__AVX2__)
    return static_cast<unsigned>(_mm256_movemask_pd((__m256d)v));
#elif defined(__SSE2__)
    return static_cast<unsigned>(_mm_movemask_pd((__m128d)v));
#else
    unsigned bits = 0;
    for (int i = 0; i < kDoubles; ++i) bits |= static_cast<unsigned>(v[i] < 0) << i;
    return bits;
#endif
}

// Bit i says whether lane i of a is at most that of b.
inline unsigned at_most(Floats a, Floats b) {
#if defined(__AVX512F__)
    return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OS);  // GCC goes a longer way from the comparison
#else
    return signs((Ints)(a <= b));  // where long has 32 bits, Clang compares to a vector of those
#endif
}

constexpr unsigned kAllLanes = (1u << kLanes) - 1;

typedef float Four __attribute__((vector_size(16)));

inline Four load_four(const float* p) {
    Four v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
inline void store_four(float* p, Four v) { __builtin_memcpy(p, &v, sizeof v); }

// Three values of each of four pixels, side by side in memory.
inline void store_interleaved(float* p, Four x, Four y, Four z) {
#if defined(__SSE2__)
    const __m128 r = (__m128)x, g = (__m128)y, b = (__m128)z;
    _mm_storeu_ps(p, _mm_shuffle_ps(_mm_unpacklo_ps(r, g), _mm_shuffle_ps(b, r, 0x50), 0x84));
    _mm_storeu_ps(p + 4, _mm_shuffle_ps(_mm_shuffle_ps(g, b, 0x55), _mm_unpackhi_ps(r, g), 0x48));
    _mm_storeu_ps(p + 8, _mm_shuffle_ps(_mm_shuffle_ps(b, r, 0xfa), _mm_shuffle_ps(g, b, 0xff), 0x88));
#else
    for (int k = 0; k < 4; ++k) p[3 * k] = x[k], p[3 * k + 1] = y[k], p[3 * k + 2] = z[k];
#endif
}
inline void load_interleaved(const float* p, Four& x, Four& y, Four& z) {
#if defined(__SSE2__)
    const __m128 a = _mm_loadu_ps(p), b = _mm_loadu_ps(p + 4), c = _mm_loadu_ps(p + 8);
    x = (Four)_mm_shuffle_ps(a, _mm_shuffle_ps(b, c, 0x5a), 0x8c);
    y = (Four)_mm_shuffle_ps(_mm_shuffle_ps(a, b, 0x05), _mm_shuffle_ps(b, c, 0xaf), 0x88);
    z = (Four)_mm_shuffle_ps(_mm_shuffle_ps(a, b, 0x5a), c, 0xc8);
#else
    for (int k = 0; k < 4; ++k) x[k] = p[3 * k], y[k] = p[3 * k + 1], z[k] = p[3 * k + 2];
#endif
}

// The sums of the lanes of four vectors. In few instructions: the backward pass takes nine for each splat in a tile.

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

}  // namespace
