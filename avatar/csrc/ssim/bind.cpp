#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <limits>

#include "python/arguments.h"
#include "ssim/ssim.h"

namespace nb = nanobind;
using namespace avatar::ssim;
using avatar::check_shape;

void bind_ssim(nb::module_& m) {
    using Floats = avatar::Array<float>;
    using ConstFloats = avatar::Array<const float>;

    m.def(
        "dssim",
        [](ConstFloats image, ConstFloats target, ConstFloats mask, const std::string& simd, int threads,
           std::optional<Floats> gradient) {
            avatar::Size H("H"), W("W");
            check_shape("image", image, {H, W, kChannels});
            check_shape("target", target, {H, W, kChannels});
            check_shape("mask", mask, {H, W});
            if (gradient) check_shape("gradient", *gradient, {H, W, kChannels});
            constexpr int kMost = std::numeric_limits<int>::max() / (2 * kChannels);  // values of a row are counted as int
            avatar::check_within("the height of image", H.value, kTaps, kMost);
            avatar::check_within("the width of image", W.value, kTaps, kMost);
            avatar::check_threads(threads);
            const Images images{image.data(), target.data(), mask.data(), H.as_int(), W.as_int()};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            return dssim(images, kernels, threads, gradient ? gradient->data() : nullptr);
        },
        nb::arg("image").noconvert(), nb::arg("target").noconvert(), nb::arg("mask").noconvert(), nb::arg("simd"),
        nb::arg("threads"), nb::arg("gradient").noconvert().none());
}
