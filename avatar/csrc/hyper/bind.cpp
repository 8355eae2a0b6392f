#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "hyper/kernels.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::hyper;

namespace {

template <typename T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kGrain = 256;  // rows that a thread takes at a time

// The arrays of mean, lower and cross of each head.
using Parameters = std::array<Array<const float>, 3 * kHeads>;
using Gradients = std::array<Array<float>, 3 * kHeads>;

std::array<Head, kHeads> heads_of(const Parameters& p) {
    std::array<Head, kHeads> heads;
    for (int h = 0; h < kHeads; ++h) heads[h] = {p[3 * h].data(), p[3 * h + 1].data(), p[3 * h + 2].data()};
    return heads;
}

}  // namespace

void bind_hyper(nb::module_& m) {
    m.def(
        "hyper_forward",
        [](const Parameters& parameters, Array<const float> latents, const std::string& simd, int threads,
           Array<float> offsets, std::optional<Array<float>> solved) {
            const Kernels& kernels = select_kernels(simd.c_str());
            const auto heads = heads_of(parameters);
            const auto n = static_cast<std::int64_t>(latents.shape(1));
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, latents.shape(0), kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.forward(heads.data(), latents.data(), n, begin, end, offsets.data(),
                                solved ? solved->data() : nullptr);
            });
        },
        nb::arg("parameters").noconvert(), nb::arg("latents").noconvert(), nb::arg("simd"), nb::arg("threads"),
        nb::arg("offsets").noconvert(), nb::arg("solved").noconvert().none());

    m.def(
        "hyper_backward",
        [](const Parameters& parameters, Array<const float> latents, Array<const float> solved,
           Array<const float> grad_offsets, const std::string& simd, int threads, std::optional<Gradients> gradients,
           std::optional<Array<float>> grad_latents) {
            const Kernels& kernels = select_kernels(simd.c_str());
            const auto heads = heads_of(parameters);
            std::array<HeadGradient, kHeads> own{};
            for (int h = 0; gradients && h < kHeads; ++h)
                own[h] = {(*gradients)[3 * h].data(), (*gradients)[3 * h + 1].data(), (*gradients)[3 * h + 2].data()};
            const auto n = static_cast<std::int64_t>(latents.shape(1));
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, latents.shape(0), kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.backward(heads.data(), latents.data(), solved.data(), grad_offsets.data(), n, begin, end,
                                 gradients ? own.data() : nullptr, grad_latents ? grad_latents->data() : nullptr);
            });
        },
        nb::arg("parameters").noconvert(), nb::arg("latents").noconvert(), nb::arg("solved").noconvert(),
        nb::arg("grad_offsets").noconvert(), nb::arg("simd"), nb::arg("threads"), nb::arg("gradients").noconvert().none(),
        nb::arg("grad_latents").noconvert().none());

    m.def(
        "hyper_apply",
        [](Array<const float> matrix, Array<const float> bias, Array<const float> latents, const std::string& simd,
           int threads, Array<float> offsets) {
            const Kernels& kernels = select_kernels(simd.c_str());
            const auto n = static_cast<std::int64_t>(latents.shape(1));
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, latents.shape(0), kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.apply(matrix.data(), bias.data(), latents.data(), n, begin, end, offsets.data());
            });
        },
        nb::arg("matrix").noconvert(), nb::arg("bias").noconvert(), nb::arg("latents").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("offsets").noconvert());

    m.def(
        "interpolate_forward",
        [](Array<const float> grid, Array<const std::int32_t> cells, Array<const float> weights,
           const std::string& simd, int threads, Array<float> out) {
            const Kernels& kernels = select_kernels(simd.c_str());
            const Corners corners{cells.data(), weights.data()};
            const auto n = static_cast<std::int64_t>(out.shape(1));
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, out.shape(0), kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.interpolate(corners, grid.data(), n, begin, end, out.data());
            });
        },
        nb::arg("grid").noconvert(), nb::arg("cells").noconvert(), nb::arg("weights").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("out").noconvert());

    m.def(
        "interpolate_backward",
        [](Array<const float> grad, Array<const std::int64_t> begins, Array<const std::int32_t> gaussians,
           Array<const float> weights, const std::string& simd, int threads, Array<float> grad_grid) {
            const Kernels& kernels = select_kernels(simd.c_str());
            const Touching touching{begins.data(), gaussians.data(), weights.data()};
            const auto n = static_cast<std::int64_t>(grad_grid.shape(1));
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, grad_grid.shape(0), kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.interpolate_backward(touching, grad.data(), n, begin, end, grad_grid.data());
            });
        },
        nb::arg("grad").noconvert(), nb::arg("begins").noconvert(), nb::arg("gaussians").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("simd"), nb::arg("threads"), nb::arg("grad_grid").noconvert());
}
