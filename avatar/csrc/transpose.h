#pragma once
// Rows of memory to values side by side, and back. Included only by the kernels, as simd.h.
#include "simd.h"

namespace {

#if defined(__SSE2__)
// Quarter q of the result is rows[4 * q][0 .. 3].
inline Floats load_quarters(const float* const* rows, int column) {
    const __m128 first = _mm_loadu_ps(rows[0] + column);
#if defined(__AVX512F__)
    __m512 v = _mm512_zextps128_ps512(first);
    v = _mm512_maskz_insertf32x4(0xffff, v, _mm_loadu_ps(rows[4] + column), 1);
    v = _mm512_maskz_insertf32x4(0xffff, v, _mm_loadu_ps(rows[8] + column), 2);
    return (Floats)_mm512_maskz_insertf32x4(0xffff, v, _mm_loadu_ps(rows[12] + column), 3);
#elif defined(__AVX2__)
    return (Floats)_mm256_insertf128_ps(_mm256_castps128_ps256(first), _mm_loadu_ps(rows[4] + column), 1);
#else
    return (Floats)first;
#endif
}

inline void store_quarters(Floats v, float* const* rows, int column) {
#if defined(__AVX512F__)
    __builtin_memcpy(rows[0] + column, &v, sizeof(__m128));
    _mm_storeu_ps(rows[4] + column, _mm512_maskz_extractf32x4_ps(0xf, (__m512)v, 1));
    _mm_storeu_ps(rows[8] + column, _mm512_maskz_extractf32x4_ps(0xf, (__m512)v, 2));
    _mm_storeu_ps(rows[12] + column, _mm512_maskz_extractf32x4_ps(0xf, (__m512)v, 3));
#elif defined(__AVX2__)
    _mm_storeu_ps(rows[0] + column, _mm256_castps256_ps128((__m256)v));
    _mm_storeu_ps(rows[4] + column, _mm256_extractf128_ps((__m256)v, 1));
#else
    _mm_storeu_ps(rows[0] + column, (__m128)v);
#endif
}

// In every quarter, as a matrix of 4 x 4.
inline void transpose_quarters(Floats v[4]) {
#if defined(__AVX512F__)
    const auto low = [](Floats a, Floats b) { return _mm512_maskz_unpacklo_ps(0xffff, (__m512)a, (__m512)b); };
    const auto high = [](Floats a, Floats b) { return _mm512_maskz_unpackhi_ps(0xffff, (__m512)a, (__m512)b); };
    const __m512 a = low(v[0], v[2]), b = low(v[1], v[3]), c = high(v[0], v[2]), d = high(v[1], v[3]);
#elif defined(__AVX2__)
    const auto low = [](Floats a, Floats b) { return _mm256_unpacklo_ps((__m256)a, (__m256)b); };
    const auto high = [](Floats a, Floats b) { return _mm256_unpackhi_ps((__m256)a, (__m256)b); };
    const __m256 a = low(v[0], v[2]), b = low(v[1], v[3]), c = high(v[0], v[2]), d = high(v[1], v[3]);
#else
    const auto low = [](Floats a, Floats b) { return _mm_unpacklo_ps((__m128)a, (__m128)b); };
    const auto high = [](Floats a, Floats b) { return _mm_unpackhi_ps((__m128)a, (__m128)b); };
    const __m128 a = low(v[0], v[2]), b = low(v[1], v[3]), c = high(v[0], v[2]), d = high(v[1], v[3]);
#endif
    v[0] = (Floats)low((Floats)a, (Floats)b);
    v[1] = (Floats)high((Floats)a, (Floats)b);
    v[2] = (Floats)low((Floats)c, (Floats)d);
    v[3] = (Floats)high((Floats)c, (Floats)d);
}
#endif

// to[i][row] = rows[row][i] for i < size.
template <int kRows>
inline void transpose_in(const float* const rows[kRows], int size, float (*to)[kRows]) {
    int i = 0;
#if defined(__SSE2__)
    static_assert(kRows % kLanes == 0);
    for (; i + 4 <= size; i += 4)
        for (int row = 0; row < kRows; row += kLanes) {
            Floats v[4];
            for (int k = 0; k < 4; ++k) v[k] = load_quarters(rows + row + k, i);
            transpose_quarters(v);
            for (int k = 0; k < 4; ++k) store(to[i + k] + row, v[k]);
        }
#endif
    for (; i < size; ++i)
        for (int row = 0; row < kRows; ++row) to[i][row] = rows[row][i];
}

// rows[row][i] = from[i][row] for i < size.
template <int kRows>
inline void transpose_out(const float (*from)[kRows], int size, float* const rows[kRows]) {
    int i = 0;
#if defined(__SSE2__)
    for (; i + 4 <= size; i += 4)
        for (int row = 0; row < kRows; row += kLanes) {
            Floats v[4];
            for (int k = 0; k < 4; ++k) v[k] = load(from[i + k] + row);
            transpose_quarters(v);
            for (int k = 0; k < 4; ++k) store_quarters(v[k], rows + row + k, i);
        }
#endif
    for (; i < size; ++i)
        for (int row = 0; row < kRows; ++row) rows[row][i] = from[i][row];
}

}  // namespace
