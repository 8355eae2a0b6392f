#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "ssim/ssim.h"

namespace nb = nanobind;
using namespace avatar::ssim;

void bind_ssim(nb::module_& m) {
    using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
    using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

    m.def(
        "dssim",
        [](ConstFloats image, ConstFloats target, ConstFloats mask, const std::string& simd, int threads,
           std::optional<Floats> gradient) {
            const Images images{image.data(), target.data(), mask.data(), static_cast<int>(mask.shape(0)),
                                static_cast<int>(mask.shape(1))};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            return dssim(images, kernels, threads, gradient ? gradient->data() : nullptr);
        },
        nb::arg("image").noconvert(), nb::arg("target").noconvert(), nb::arg("mask").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("gradient").noconvert().none());
}
