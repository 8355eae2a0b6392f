#include <nanobind/nanobind.h>

#include "mesh/rasterize.h"
#include "python/arguments.h"

namespace nb = nanobind;
using avatar::Array;
using avatar::check_shape;

void bind_mesh(nb::module_& m) {
    m.def(
        "rasterize_mesh",
        [](Array<const float> screen, Array<const std::int32_t> faces, Array<std::int32_t> face_id,
           Array<float> barycentric, Array<float> depth) {
            avatar::Size V("V"), F("F"), H("H"), W("W");
            check_shape("screen", screen, {V, 3});
            check_shape("faces", faces, {F, 3});
            check_shape("face_id", face_id, {H, W});
            check_shape("barycentric", barycentric, {H, W, 3});
            check_shape("depth", depth, {H, W});
            avatar::check_indices("faces", faces, V.value);
            const nb::gil_scoped_release unlocked;
            avatar::rasterize_mesh(screen.data(), faces.data(), F.value, H.as_int(), W.as_int(), face_id.data(),
                                   barycentric.data(), depth.data());
        },
        nb::arg("screen").noconvert(), nb::arg("faces").noconvert(), nb::arg("face_id").noconvert(),
        nb::arg("barycentric").noconvert(), nb::arg("depth").noconvert());
}
