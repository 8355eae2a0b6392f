#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include "compose/compose.h"
#include "thread_pool.h"

namespace nb = nanobind;
using namespace avatar::compose;

void bind_compose(nb::module_& m) {
    using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
    using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
    static constexpr std::int64_t kGrain = 1024;  // Gaussians handed to a thread at a time

    m.def(
        "compose_forward",
        [](ConstFloats points, ConstFloats quats, ConstFloats log_scales, ConstFloats opacity_logits, ConstFloats raw,
           const std::string& simd, int threads, Floats means, Floats out_quats, Floats scales, Floats opacities) {
            const Parameters parameters{points.data(), quats.data(), log_scales.data(), opacity_logits.data(),
                                        raw.data()};
            const Composed composed{means.data(), out_quats.data(), scales.data(), opacities.data()};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, static_cast<std::int64_t>(raw.shape(0)), kGrain,
                                 [&](std::int64_t begin, std::int64_t end) {
                                     kernels.forward(parameters, begin, end, composed);
                                 });
        },
        nb::arg("points").noconvert(), nb::arg("quats").noconvert(), nb::arg("log_scales").noconvert(),
        nb::arg("opacity_logits").noconvert(), nb::arg("raw").noconvert(), nb::arg("simd"), nb::arg("threads"),
        nb::arg("means").noconvert(), nb::arg("out_quats").noconvert(), nb::arg("scales").noconvert(),
        nb::arg("opacities").noconvert());

    m.def(
        "compose_backward",
        [](ConstFloats quats, ConstFloats log_scales, ConstFloats raw, ConstFloats scales, ConstFloats opacities,
           ConstFloats by_means, ConstFloats by_quats, ConstFloats by_scales, ConstFloats by_opacities,
           const std::string& simd, int threads, Floats grad_quats, Floats grad_log_scales,
           Floats grad_opacity_logits, Floats grad_raw) {
            const Parameters parameters{nullptr, quats.data(), log_scales.data(), nullptr, raw.data()};
            const Upstream upstream{by_means.data(),     by_quats.data(), by_scales.data(),
                                    by_opacities.data(), scales.data(),   opacities.data()};
            const Gradients gradients{grad_quats.data(), grad_log_scales.data(), grad_opacity_logits.data(),
                                      grad_raw.data()};
            const Kernels& kernels = select_kernels(simd.c_str());
            const nb::gil_scoped_release unlocked;
            avatar::parallel_for(threads, static_cast<std::int64_t>(raw.shape(0)), kGrain,
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
