#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "arguments.h"
#include "hyper/kernels.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::hyper;
using avatar::Array;
using avatar::check_shape;
using avatar::Size;

namespace {

constexpr std::int64_t kGrain = 256;  // rows that a thread takes at a time

// The arrays of mean, lower and cross of each head.
using Parameters = std::array<Array<const float>, 3 * kHeads>;
using Gradients = std::array<Array<float>, 3 * kHeads>;

template <typename Arrays>
void check_heads(const std::string& name, const Arrays& arrays, Size& N, Size& n) {
    for (int h = 0; h < kHeads; ++h) {
        const auto check = [&](int part, std::initializer_list<avatar::Extent> extents) {
            check_shape(name + "[" + std::to_string(3 * h + part) + "]", arrays[3 * h + part], extents);
        };
        const int m = kAttributeSizes[h];
        check(0, {N, m + n.value});
        check(1, {N, m, m});
        check(2, {N, n, m});
    }
}

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
            Size N("N"), n("n");
            check_shape("latents", latents, {N, n});
            check_heads("parameters", parameters, N, n);
            check_shape("offsets", offsets, {N, kOffsets});
            if (solved) check_shape("solved", *solved, {N, kOffsets});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const auto heads = heads_of(parameters);
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.forward(heads.data(), latents.data(), n.value, begin, end, offsets.data(),
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
            if (!gradients && !grad_latents)
                throw std::invalid_argument("gradients or grad_latents must be given, got None for both");
            Size N("N"), n("n");
            check_shape("latents", latents, {N, n});
            check_heads("parameters", parameters, N, n);
            check_shape("solved", solved, {N, kOffsets});
            check_shape("grad_offsets", grad_offsets, {N, kOffsets});
            if (gradients) check_heads("gradients", *gradients, N, n);
            if (grad_latents) check_shape("grad_latents", *grad_latents, {N, n});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const auto heads = heads_of(parameters);
            std::array<HeadGradient, kHeads> own{};
            for (int h = 0; gradients && h < kHeads; ++h)
                own[h] = {(*gradients)[3 * h].data(), (*gradients)[3 * h + 1].data(), (*gradients)[3 * h + 2].data()};
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.backward(heads.data(), latents.data(), solved.data(), grad_offsets.data(), n.value, begin, end,
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
            Size N("N"), n("n");
            check_shape("latents", latents, {N, n});
            check_shape("matrix", matrix, {N, n, kOffsets});
            check_shape("bias", bias, {N, kOffsets});
            check_shape("offsets", offsets, {N, kOffsets});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.apply(matrix.data(), bias.data(), latents.data(), n.value, begin, end, offsets.data());
            });
        },
        nb::arg("matrix").noconvert(), nb::arg("bias").noconvert(), nb::arg("latents").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("offsets").noconvert());

    m.def(
        "interpolate_forward",
        [](Array<const float> grid, Array<const std::int32_t> cells, Array<const float> weights,
           const std::string& simd, int threads, Array<float> out) {
            Size N("N"), n("n"), G("G");
            check_shape("grid", grid, {G, n});
            check_shape("cells", cells, {N, 4});
            check_shape("weights", weights, {N, 4});
            check_shape("out", out, {N, n});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const Corners corners{cells.data(), weights.data()};
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.interpolate(corners, grid.data(), n.value, begin, end, out.data());
            });
        },
        nb::arg("grid").noconvert(), nb::arg("cells").noconvert(), nb::arg("weights").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("out").noconvert());

    m.def(
        "interpolate_backward",
        [](Array<const float> grad, Array<const std::int64_t> begins, Array<const std::int32_t> gaussians,
           Array<const float> weights, const std::string& simd, int threads, Array<float> grad_grid) {
            Size N("N"), n("n"), G("G"), corners("corners");
            check_shape("grad", grad, {N, n});
            check_shape("grad_grid", grad_grid, {G, n});
            check_shape("begins", begins, {G.value + 1});
            check_shape("gaussians", gaussians, {corners});
            check_shape("weights", weights, {corners});
            avatar::check_within("the last value of begins", begins.data()[G.value], corners.value, corners.value);
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const Touching touching{begins.data(), gaussians.data(), weights.data()};
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, G.value, kGrain, [&](std::int64_t begin, std::int64_t end) {
                kernels.interpolate_backward(touching, grad.data(), n.value, begin, end, grad_grid.data());
            });
        },
        nb::arg("grad").noconvert(), nb::arg("begins").noconvert(), nb::arg("gaussians").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("simd"), nb::arg("threads"), nb::arg("grad_grid").noconvert());
}
