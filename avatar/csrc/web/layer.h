#pragma once
#include <algorithm>
#include <cstdint>

#include "simd.h"

// One layer of a small network for many inputs, on one thread.
namespace avatar::web {
namespace {

constexpr int kRows = 4;  // inputs at a time: four times two vectors of sums stay in registers

// out[r][0 .. kVectors * kLanes) for kRows rows; `block` holds the columns' weights, [depth][kVectors * kLanes].
template <bool relu, int kVectors>
void four_rows(const float* const x[kRows], const float* block, const float* bias, int depth, float* const out[kRows]) {
    Floats sums[kRows][kVectors];
    for (int r = 0; r < kRows; ++r)
        for (int v = 0; v < kVectors; ++v) sums[r][v] = load_anywhere(bias + v * kLanes);
    for (int k = 0; k < depth; ++k) {
        Floats w[kVectors];
        for (int v = 0; v < kVectors; ++v) w[v] = load_anywhere(block + (k * kVectors + v) * kLanes);
        for (int r = 0; r < kRows; ++r) {
            const Floats value = broadcast(x[r][k]);
            for (int v = 0; v < kVectors; ++v) sums[r][v] = fma(value, w[v], sums[r][v]);
        }
    }
    for (int r = 0; r < kRows; ++r)
        for (int v = 0; v < kVectors; ++v)
            store_anywhere(out[r] + v * kLanes, relu ? max(sums[r][v], Floats{}) : sums[r][v]);
}

// Columns [first, first + kVectors * kLanes) of all rows. `block` is room for their weights.
template <bool relu, int kVectors>
void columns(const float* x, const float* w, const float* bias, int rows, int depth, int width, int first, float* block,
             float* out) {
    constexpr int kWide = kVectors * kLanes;
    for (int k = 0; k < depth; ++k) std::copy_n(w + std::int64_t{k} * width + first, kWide, block + k * kWide);
    for (int begin = 0; begin < rows; begin += kRows) {
        const float* from[kRows];
        float* to[kRows];
        for (int r = 0; r < kRows; ++r) {
            const std::int64_t row = std::min(begin + r, rows - 1);  // the last one again where rows end
            from[r] = x + row * depth;
            to[r] = out + row * width + first;
        }
        four_rows<relu, kVectors>(from, block, bias + first, depth, to);
    }
}

// x [rows, depth] times w [depth, width] plus bias; `block` is room for 2 * kLanes * depth values.
template <bool relu>
void layer(const float* x, const float* w, const float* bias, int rows, int depth, int width, float* block, float* out) {
    int first = 0;
    for (; first + 2 * kLanes <= width; first += 2 * kLanes)
        columns<relu, 2>(x, w, bias, rows, depth, width, first, block, out);
    for (; first + kLanes <= width; first += kLanes)
        columns<relu, 1>(x, w, bias, rows, depth, width, first, block, out);
    for (; first < width; ++first)
        for (std::int64_t row = 0; row < rows; ++row) {
            float sum = bias[first];
            for (int k = 0; k < depth; ++k) sum += x[row * depth + k] * w[std::int64_t{k} * width + first];
            out[row * width + first] = relu ? std::max(sum, 0.0f) : sum;
        }
}

}  // namespace
}  // namespace avatar::web
