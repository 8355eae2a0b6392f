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

template <typename T>
std::int64_t size_of(const Array<T>& array) {
    std::size_t size = 1;
    for (std::size_t axis = 0; axis < array.ndim(); ++axis) size *= array.shape(axis);
    return static_cast<std::int64_t>(size);
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

void check_indices(const std::string& name, const Array<const std::int32_t>& indices, std::int64_t rows) {
    const std::int64_t size = size_of(indices);
    const auto limit = static_cast<std::uint32_t>(rows);  // fits: check_shape lets no more through
    const auto is_wrong = [&](std::int64_t i) { return static_cast<std::uint32_t>(indices.data()[i]) >= limit; };
    std::uint32_t any = 0;  // first without a branch, so that what is right is seen to be so in microseconds
    for (std::int64_t i = 0; i < size; ++i) any |= is_wrong(i);
    for (std::int64_t i = 0; any != 0 && i < size; ++i)
        if (is_wrong(i))
            throw std::invalid_argument(name + " has the index " + std::to_string(indices.data()[i]) + " as value " +
                                        std::to_string(i) + ", but there are " + std::to_string(rows) + " rows");
}

void check_begins(const std::string& name, const Array<const std::int64_t>& begins, std::int64_t end) {
    const std::int64_t size = size_of(begins);
    std::int64_t before = 0;
    for (std::int64_t i = 0; i < size; ++i) {
        if (begins.data()[i] < before || begins.data()[i] > end)
            throw std::invalid_argument(name + " must rise within 0 to " + std::to_string(end) + ", but value " +
                                        std::to_string(i) + " is " + std::to_string(begins.data()[i]));
        before = begins.data()[i];
    }
    check_within("the last value of " + name, before, end, end);
}

}  // namespace avatar
