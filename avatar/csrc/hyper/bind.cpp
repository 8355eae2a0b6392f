#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "hyper/kernels.h"
#include "python/arguments.h"
#include "python/large_tensor.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::hyper;
using avatar::Array;
using avatar::check_shape;
using avatar::Size;

namespace {

constexpr std::int64_t kGrain = 256;  // rows that a thread takes at a time

std::int64_t blocks_of(const Size& gaussians) { return (gaussians.value + kBlock - 1) / kBlock; }

}  // namespace

void bind_hyper(nb::module_& m) {
    m.def(
        "hyper_forward",
        [](Array<const float> parameters, Array<const float> latents, const std::string& simd, int threads,
           Array<float> offsets, std::optional<Array<float>> solved) {
            Size N("N"), n("n");
            check_shape("latents", latents, {N, n});
            check_shape("packed", parameters, {blocks_of(N), rows_of(n.value), kBlock});
            check_shape("offsets", offsets, {N, kOffsets});
            if (solved) check_shape("solved", *solved, {blocks_of(N), kOffsets, kBlock});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, blocks_of(N), kGrain / kBlock, [&](std::int64_t begin, std::int64_t end) {
                kernels.forward(parameters.data(), latents.data(), N.value, n.value, begin, end, offsets.data(),
                                solved ? solved->data() : nullptr);
            });
        },
        nb::arg("packed").noconvert(), nb::arg("latents").noconvert(), nb::arg("simd"), nb::arg("threads"),
        nb::arg("offsets").noconvert(), nb::arg("solved").noconvert().none());

    m.def(
        "hyper_backward",
        [](Array<const float> parameters, Array<const float> latents, Array<const float> solved,
           Array<const float> grad_offsets, const std::string& simd, int threads, bool with_parameters,
           std::optional<Array<float>> grad_latents) -> std::optional<avatar::Tensor> {
            if (!with_parameters && !grad_latents)
                throw std::invalid_argument("a gradient must be wanted: with_parameters is False and grad_latents None");
            Size N("N"), n("n");
            check_shape("latents", latents, {N, n});
            check_shape("packed", parameters, {blocks_of(N), rows_of(n.value), kBlock});
            check_shape("solved", solved, {blocks_of(N), kOffsets, kBlock});
            check_shape("grad_offsets", grad_offsets, {N, kOffsets});
            if (grad_latents) check_shape("grad_latents", *grad_latents, {N, n});
            avatar::check_threads(threads);
            const Kernels& kernels = select_kernels(simd.c_str());
            std::optional<avatar::Tensor> gradient;
            if (with_parameters)
                gradient = avatar::large_tensor({parameters.shape(0), parameters.shape(1), parameters.shape(2)});
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, blocks_of(N), kGrain / kBlock, [&](std::int64_t begin, std::int64_t end) {
                kernels.backward(parameters.data(), latents.data(), solved.data(), grad_offsets.data(), N.value, n.value,
                                 begin, end, gradient ? gradient->data() : nullptr,
                                 grad_latents ? grad_latents->data() : nullptr);
            });
            return gradient;
        },
        nb::arg("packed").noconvert(), nb::arg("latents").noconvert(), nb::arg("solved").noconvert(),
        nb::arg("grad_offsets").noconvert(), nb::arg("simd"), nb::arg("threads"), nb::arg("with_parameters"),
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
            avatar::check_indices("cells", cells, G.value);
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
            avatar::check_begins("begins", begins, corners.value);
            avatar::check_indices("gaussians", gaussians, N.value);
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
