#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>

#include <limits>

#include "python/arguments.h"
#include "splat/splat.h"

namespace nb = nanobind;
using namespace avatar::splat;
using avatar::Array;
using avatar::check_shape;
using avatar::Size;

namespace {

using Floats = Array<float>;
using ConstFloats = Array<const float>;

// Also of gradients, whose names begin with `prefix`. sh must hold the coefficients of `sh_degree`, or, where that is
// kNoSh, features [N, K].
template <typename T>
void check_gaussians(const std::string& prefix, const Array<T>& means, const Array<T>& quats, const Array<T>& scales,
                     const Array<T>& opacities, const Array<T>& sh, int sh_degree, Size& N, Size& K) {
    check_shape(prefix + "means", means, {N, 3});
    check_shape(prefix + "quats", quats, {N, 4});
    check_shape(prefix + "scales", scales, {N, 3});
    check_shape(prefix + "opacities", opacities, {N});
    if (sh_degree == kNoSh) {
        check_shape(prefix + "features", sh, {N, K});
        avatar::check_within(prefix + "features' channels", K.value, 1, std::numeric_limits<int>::max());
        return;
    }
    check_shape(prefix + "sh", sh, {N, K, 3});
    avatar::check_within("sh_degree", sh_degree, 0, 3);
    avatar::check_within(prefix + "sh's coefficients", K.value, (sh_degree + 1) * (sh_degree + 1), 16);
}

Gaussians gaussians_of(const ConstFloats& means, const ConstFloats& quats, const ConstFloats& scales,
                       const ConstFloats& opacities, const ConstFloats& sh, int sh_degree) {
    const auto count = static_cast<std::int64_t>(means.shape(0));
    const int values = static_cast<int>(sh.shape(1));
    if (sh_degree == kNoSh)
        return {means.data(), quats.data(), scales.data(), opacities.data(), nullptr, count, 0, sh.data(), values};
    return {means.data(), quats.data(), scales.data(), opacities.data(), sh.data(), count, values};
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
           Floats alpha, bool everywhere) {
            Size N("N"), K("K"), H("H"), W("W");
            check_gaussians("", means, quats, scales, opacities, sh, sh_degree, N, K);
            const std::int64_t channels = sh_degree == kNoSh ? K.value : 3;
            check_shape("background", background, {channels});
            check_shape("image", image, {H, W, channels});
            check_shape("alpha", alpha, {H, W});
            avatar::check_within("region's left column", region[0], 0, W.value - 1);
            avatar::check_within("region's top row", region[1], 0, H.value - 1);
            avatar::check_within("region's end column", region[2], region[0] + 1, W.value);
            avatar::check_within("region's end row", region[3], region[1] + 1, H.value);
            avatar::check_threads(threads);
            Camera camera{{}, {}, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3],
                          W.as_int(), H.as_int()};
            for (int k = 0; k < 9; ++k) camera.rotation[k] = rotation[k];
            for (int k = 0; k < 3; ++k) camera.translation[k] = translation[k];
            const Settings settings{sh_degree, cutoffs[0], cutoffs[1], cutoffs[2], blur, near, antialiased,
                                    everywhere};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            return forward(gaussians_of(means, quats, scales, opacities, sh, sh_degree), camera, settings,
                           {region[0], region[1], region[2], region[3]}, background.data(), kernels, threads,
                           image.data(), alpha.data());
        },
        nb::arg("means").noconvert(), nb::arg("quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert(), nb::arg("sh").noconvert(), nb::arg("background").noconvert(),
        nb::arg("rotation"), nb::arg("translation"), nb::arg("intrinsics"), nb::arg("sh_degree"), nb::arg("cutoffs"),
        nb::arg("blur"), nb::arg("near"), nb::arg("antialiased"), nb::arg("region"), nb::arg("simd"),
        nb::arg("threads"), nb::arg("image").noconvert(), nb::arg("alpha").noconvert(),
        nb::arg("everywhere") = false);

    m.def(
        "splat_backward",
        [](const Drawing& drawing, ConstFloats means, ConstFloats quats, ConstFloats scales, ConstFloats opacities,
           ConstFloats sh, std::optional<ConstFloats> grad_image, std::optional<ConstFloats> grad_alpha,
           Floats grad_means, Floats grad_quats, Floats grad_scales, Floats grad_opacities, Floats grad_sh,
           Floats grad_background, std::optional<Array<double>> grad_pose) {
            Size N("N"), K("K");
            const int sh_degree = drawing.view.settings.sh_degree;
            const Camera& camera = drawing.view.camera;
            check_gaussians("", means, quats, scales, opacities, sh, sh_degree, N, K);
            const auto drawn = static_cast<std::int64_t>(drawing.lists.slot_begin.size()) - 1;
            avatar::check_within("the number of Gaussians", N.value, drawn, drawn);
            check_gaussians("grad_", grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, sh_degree, N, K);
            const std::int64_t channels = sh_degree == kNoSh ? K.value : 3;
            const auto shown = static_cast<std::int64_t>(drawing.background.size());
            avatar::check_within("the number of channels", channels, shown, shown);
            check_shape("grad_background", grad_background, {channels});
            if (grad_pose) check_shape("grad_pose", *grad_pose, {kPoseValues});
            if (grad_image) check_shape("grad_image", *grad_image, {camera.height, camera.width, channels});
            if (grad_alpha) check_shape("grad_alpha", *grad_alpha, {camera.height, camera.width});
            const bool has_features = sh_degree == kNoSh;
            const GaussianGradients gradients{grad_means.data(), grad_quats.data(), grad_scales.data(),
                                              grad_opacities.data(), has_features ? nullptr : grad_sh.data(),
                                              has_features ? grad_sh.data() : nullptr};
            const nb::gil_scoped_release unlocked;
            backward(drawing, gaussians_of(means, quats, scales, opacities, sh, sh_degree),
                     grad_image ? grad_image->data() : nullptr, grad_alpha ? grad_alpha->data() : nullptr, gradients,
                     grad_background.data(), grad_pose ? grad_pose->data() : nullptr);
        },
        nb::arg("drawing"), nb::arg("means").noconvert(), nb::arg("quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert(), nb::arg("sh").noconvert(),
        nb::arg("grad_image").noconvert().none(), nb::arg("grad_alpha").noconvert().none(),
        nb::arg("grad_means").noconvert(), nb::arg("grad_quats").noconvert(), nb::arg("grad_scales").noconvert(),
        nb::arg("grad_opacities").noconvert(), nb::arg("grad_sh").noconvert(), nb::arg("grad_background").noconvert(),
        nb::arg("grad_pose").noconvert() = nb::none());
}
