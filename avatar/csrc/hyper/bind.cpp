#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include "hyper/kernels.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::hyper;

namespace {

template <typename T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kGrain = 256;  // rows that a thread takes at a time

}  // namespace

void bind_hyper(nb::module_& m) {
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
