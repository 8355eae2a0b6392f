#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include "apply_offsets/apply_offsets.h"
#include "python/arguments.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::apply_offsets;
using avatar::check_shape;

void bind_apply_offsets(nb::module_& m) {
    using Floats = avatar::Array<float>;
    using ConstFloats = avatar::Array<const float>;
    static constexpr std::int64_t kGrain = 1024;  // Gaussians handed to a thread at a time

    m.def(
        "apply_offsets_forward",
        [](ConstFloats points, ConstFloats quats, ConstFloats log_scales, ConstFloats opacity_logits, ConstFloats raw,
           const std::string& simd, int threads, Floats means, Floats out_quats, Floats scales, Floats opacities) {
            avatar::Size N("N");
            check_shape("points", points, {N, 3});
            check_shape("quats", quats, {N, 4});
            check_shape("log_scales", log_scales, {N, 3});
            check_shape("opacity_logits", opacity_logits, {N});
            check_shape("raw", raw, {N, 10});
            check_shape("means", means, {N, 3});
            check_shape("out_quats", out_quats, {N, 4});
            check_shape("scales", scales, {N, 3});
            check_shape("opacities", opacities, {N});
            avatar::check_threads(threads);
            const Parameters parameters{points.data(), quats.data(), log_scales.data(), opacity_logits.data(),
                                        raw.data()};
            const Activated activated{means.data(), out_quats.data(), scales.data(), opacities.data()};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain,
                                 [&](std::int64_t begin, std::int64_t end) {
                                     kernels.forward(parameters, begin, end, activated);
                                 });
        },
        nb::arg("points").noconvert(), nb::arg("quats").noconvert(), nb::arg("log_scales").noconvert(),
        nb::arg("opacity_logits").noconvert(), nb::arg("raw").noconvert(), nb::arg("simd"), nb::arg("threads"),
        nb::arg("means").noconvert(), nb::arg("out_quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert());

    m.def(
        "apply_offsets_backward",
        [](ConstFloats quats, ConstFloats log_scales, ConstFloats raw, ConstFloats scales, ConstFloats opacities,
           ConstFloats by_means, ConstFloats by_quats, ConstFloats by_scales, ConstFloats by_opacities,
           const std::string& simd, int threads, Floats grad_quats, Floats grad_log_scales,
           Floats grad_opacity_logits, Floats grad_raw) {
            avatar::Size N("N");
            check_shape("quats", quats, {N, 4});
            check_shape("log_scales", log_scales, {N, 3});
            check_shape("raw", raw, {N, 10});
            check_shape("scales", scales, {N, 3});
            check_shape("opacities", opacities, {N});
            check_shape("by_means", by_means, {N, 3});
            check_shape("by_quats", by_quats, {N, 4});
            check_shape("by_scales", by_scales, {N, 3});
            check_shape("by_opacities", by_opacities, {N});
            check_shape("grad_quats", grad_quats, {N, 4});
            check_shape("grad_log_scales", grad_log_scales, {N, 3});
            check_shape("grad_opacity_logits", grad_opacity_logits, {N});
            check_shape("grad_raw", grad_raw, {N, 10});
            avatar::check_threads(threads);
            const Parameters parameters{nullptr, quats.data(), log_scales.data(), nullptr, raw.data()};
            const Upstream upstream{by_means.data(),     by_quats.data(), by_scales.data(),
                                    by_opacities.data(), scales.data(),   opacities.data()};
            const Gradients gradients{grad_quats.data(), grad_log_scales.data(), grad_opacity_logits.data(),
                                      grad_raw.data()};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, N.value, kGrain,
                                 [&](std::int64_t begin, std::int64_t end) {
                                     kernels.backward(parameters, upstream, begin, end, gradients);
                                 });
        },
        nb::arg("quats").noconvert(), nb::arg("log_scales").noconvert(), nb::arg("raw").noconvert(),
        nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(), nb::arg("by_means").noconvert(),
        nb::arg("by_quats").noconvert(), nb::arg("by_scales").noconvert(), nb::arg("by_opacities").noconvert(),
        nb::arg("simd"), nb::arg("threads"), nb::arg("grad_quats").noconvert(),
        nb::arg("grad_log_scales").noconvert(), nb::arg("grad_opacity_logits").noconvert(),
        nb::arg("grad_raw").noconvert());
}
