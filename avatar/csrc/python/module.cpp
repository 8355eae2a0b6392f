// The one extension module, `avatar._core`. Private: the public functions that check and document live in Python.
#include <nanobind/nanobind.h>

#include <cstdlib>

namespace nb = nanobind;

void bind_apply_offsets(nb::module_& m);
void bind_hyper(nb::module_& m);
void bind_large_tensor(nb::module_& m);
void bind_mesh(nb::module_& m);
void bind_splat(nb::module_& m);
void bind_ssim(nb::module_& m);

NB_MODULE(_core, m) {
    // A rendered tensor that is alive when the interpreter ends keeps its autograd graph, and so a Drawing, alive with it.
    nb::set_leak_warnings(false);
    // Every call of an operator asks, and os.environ takes longer over it than some of them.
    m.def("environment", [](const char* name) -> const char* { return std::getenv(name); }, nb::arg("name"));
    bind_apply_offsets(m);
    bind_hyper(m);
    bind_large_tensor(m);
    bind_mesh(m);
    bind_splat(m);
    bind_ssim(m);
}
