// The one extension module, `avatar._core`. Private: the public functions that check and document live in Python.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

void bind_mesh(nb::module_& m);

NB_MODULE(_core, m) {
    bind_mesh(m);
}
