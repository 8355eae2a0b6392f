#include "python/arguments.h"

namespace avatar {
namespace {

// DLPack's table for the exchange of arrays in C, https://dmlc.github.io/dlpack/latest/c_api.html, from version 1.3 on.
struct ExchangeTable {
    std::uint32_t major, minor;
    void* previous;
    void *allocate, *from_object, *to_object;
    Lend lend;
    void* current_stream;
};

Lend find_lender(PyTypeObject* type) noexcept {
    PyObject* const capsule = PyObject_GetAttrString(reinterpret_cast<PyObject*>(type), "__dlpack_c_exchange_api__");
    const auto* const table =
        capsule == nullptr ? nullptr
                           : static_cast<const ExchangeTable*>(PyCapsule_GetPointer(capsule, "dlpack_exchange_api"));
    Py_XDECREF(capsule);  // the table lives as long as the process
    PyErr_Clear();
    return table != nullptr && table->major == 1 ? table->lend : nullptr;
}

}  // namespace

Lend lender_of(PyTypeObject* type) noexcept {
    // Tensor, Parameter and numpy's array; the lock is Python's own. A type that is here stays alive.
    static std::array<std::pair<PyTypeObject*, Lend>, 4> known{};
    static std::size_t next = 0;
    for (const auto& [one, lend] : known)
        if (one == type) return lend;
    auto& place = known[next++ % known.size()];
    Py_INCREF(type);
    Py_XDECREF(place.first);
    place = {type, find_lender(type)};
    return place.second;
}

bool is_in_c_order(const nanobind::dlpack::dltensor& tensor) noexcept {
    if (tensor.strides == nullptr) return true;
    std::int64_t expected = 1;
    bool ordered = true;
    for (std::int32_t axis = tensor.ndim - 1; axis >= 0; --axis) {
        if (tensor.shape[axis] == 0) return true;
        ordered = ordered && (tensor.shape[axis] == 1 || tensor.strides[axis] == expected);
        expected *= tensor.shape[axis];
    }
    return ordered;
}

}  // namespace avatar
