#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>

#include <cstring>

#include "splat/splat.h"

namespace nb = nanobind;
using namespace avatar::splat;

namespace {

using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
constexpr std::size_t kCounts = sizeof(Counts) / sizeof(std::int64_t);
using Integers = nb::ndarray<std::int64_t, nb::shape<kCounts>, nb::c_contig, nb::device::cpu>;
using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

Gaussians gaussians_of(const ConstFloats& means, const ConstFloats& quats, const ConstFloats& scales,
                       const ConstFloats& opacities, const ConstFloats& sh) {
    return {means.data(),     quats.data(), scales.data(),
            opacities.data(), sh.data(),    static_cast<std::int64_t>(means.shape(0)),
            static_cast<int>(sh.shape(1))};
}

}  // namespace

void bind_splat(nb::module_& m) {
    nb::class_<Drawing>(m, "Drawing");

    m.def(
        "splat_forward",
        [](ConstFloats means, ConstFloats quats, ConstFloats scales, ConstFloats opacities, ConstFloats sh,
           ConstFloats background, std::array<double, 9> rotation, std::array<double, 3> translation,
           std::array<double, 4> intrinsics, int sh_degree, std::array<float, 3> cutoffs, double blur, double near,
           bool antialiased, std::array<int, 4> region, const std::string& simd, int threads, Floats image,
           Floats alpha, std::optional<Integers> counts, bool everywhere) {
            Camera camera{{}, {}, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3],
                          static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0))};
            for (int k = 0; k < 9; ++k) camera.rotation[k] = rotation[k];
            for (int k = 0; k < 3; ++k) camera.translation[k] = translation[k];
            const Settings settings{sh_degree, cutoffs[0], cutoffs[1], cutoffs[2], blur, near, antialiased,
                                    everywhere};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            Counts counted{};
            auto drawing = forward(gaussians_of(means, quats, scales, opacities, sh), camera, settings,
                           {region[0], region[1], region[2], region[3]}, background.data(), kernels, threads,
                           image.data(), alpha.data(), counts ? &counted : nullptr);
            if (counts) std::memcpy(counts->data(), &counted, sizeof counted);
            return drawing;
        },
        nb::arg("means").noconvert(), nb::arg("quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert(), nb::arg("sh").noconvert(), nb::arg("background").noconvert(),
        nb::arg("rotation"), nb::arg("translation"), nb::arg("intrinsics"), nb::arg("sh_degree"), nb::arg("cutoffs"),
        nb::arg("blur"), nb::arg("near"), nb::arg("antialiased"), nb::arg("region"), nb::arg("simd"),
        nb::arg("threads"), nb::arg("image").noconvert(), nb::arg("alpha").noconvert(),
        nb::arg("counts").noconvert() = nb::none(), nb::arg("everywhere") = false);

    m.def(
        "splat_backward",
        [](const Drawing& drawing, ConstFloats means, ConstFloats quats, ConstFloats scales, ConstFloats opacities,
           ConstFloats sh, std::optional<ConstFloats> grad_image, std::optional<ConstFloats> grad_alpha,
           Floats grad_means, Floats grad_quats, Floats grad_scales, Floats grad_opacities, Floats grad_sh,
           Floats grad_background) {
            const GaussianGradients gradients{grad_means.data(), grad_quats.data(), grad_scales.data(),
                                              grad_opacities.data(), grad_sh.data()};
            const nb::gil_scoped_release unlocked;
            backward(drawing, gaussians_of(means, quats, scales, opacities, sh),
                     grad_image ? grad_image->data() : nullptr, grad_alpha ? grad_alpha->data() : nullptr, gradients,
                     grad_background.data());
        },
        nb::arg("drawing"), nb::arg("means").noconvert(), nb::arg("quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert(), nb::arg("sh").noconvert(),
        nb::arg("grad_image").noconvert().none(), nb::arg("grad_alpha").noconvert().none(),
        nb::arg("grad_means").noconvert(), nb::arg("grad_quats").noconvert(), nb::arg("grad_scales").noconvert(),
        nb::arg("grad_opacities").noconvert(), nb::arg("grad_sh").noconvert(), nb::arg("grad_background").noconvert());
}
