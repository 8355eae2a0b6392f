#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "mesh/rasterize.h"

namespace nb = nanobind;

void bind_mesh(nb::module_& m) {
    using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
    using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
    using Ints = nb::ndarray<std::int32_t, nb::c_contig, nb::device::cpu>;
    using ConstInts = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;

    m.def(
        "rasterize_mesh",
        [](ConstFloats screen, ConstInts faces, Ints face_id, Floats barycentric, Floats depth) {
            const int height = static_cast<int>(face_id.shape(0)), width = static_cast<int>(face_id.shape(1));
            nb::gil_scoped_release unlocked;
            avatar::rasterize_mesh(screen.data(), faces.data(), static_cast<std::int64_t>(faces.shape(0)), height,
                                   width, face_id.data(), barycentric.data(), depth.data());
        },
        nb::arg("screen").noconvert(), nb::arg("faces").noconvert(), nb::arg("face_id").noconvert(),
        nb::arg("barycentric").noconvert(), nb::arg("depth").noconvert());
}
