#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <cstdint>
#include <initializer_list>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

// What the compiled functions demand of their arguments, so that none can read or write beyond an array. The order of its
// values, its type and its device are demanded by the type Array; ranks, sizes and the range of indices here, in the words
// of avatar/tensors.py.
namespace avatar {

// An array in C order on the CPU that a caller lends for the time of a call.
template <typename T>
class Array {
public:
    using Any = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu>;

    Array() = default;
    Array(T* data, std::size_t ndim, const std::int64_t* shape) : data_(data), ndim_(ndim), shape_(shape) {}
    explicit Array(Any array)
        : data_(array.data()), ndim_(array.ndim()), shape_(array.shape_ptr()), owner_(std::move(array)) {}

    T* data() const { return data_; }
    std::size_t ndim() const { return ndim_; }
    std::size_t shape(std::size_t axis) const { return static_cast<std::size_t>(shape_[axis]); }

private:
    T* data_ = nullptr;
    std::size_t ndim_ = 0;
    const std::int64_t* shape_ = nullptr;
    Any owner_;
};

// The function with which a type lends its arrays without a detour through Python, or null. Torch's tensors have one from
// 2.10 on; without it a small operator spends more time on its arguments than on its work.
using Lend = int (*)(void* object, nanobind::dlpack::dltensor* out);  // 0, or -1 with a Python exception

Lend lender_of(PyTypeObject* type) noexcept;
bool is_in_c_order(const nanobind::dlpack::dltensor& tensor) noexcept;

// A size that several arrays share. The first array that is checked sets it.
struct Size {
    explicit Size(const char* letter) : name(letter) {}
    int as_int() const { return static_cast<int>(value); }  // check_shape lets nothing larger through

    std::string name, owner;
    std::int64_t value = -1;
};

struct Extent {
    Extent(Size& size) : shared(&size) {}
    Extent(std::int64_t size) : fixed(size) {}

    Size* shared = nullptr;
    std::int64_t fixed = -1;
};

inline std::string in_brackets(const std::vector<std::string>& parts) {
    std::string text = "[";
    for (const std::string& part : parts) text += (text.size() > 1 ? ", " : "") + part;
    return text + "]";
}

// Throws std::invalid_argument with the array's name, what was expected and what was given.
template <typename T>
void check_shape(const std::string& name, const Array<T>& array, std::initializer_list<Extent> extents) {
    bool fits = array.ndim() == extents.size();
    std::vector<std::string> expected, given;
    for (std::size_t axis = 0; axis < array.ndim(); ++axis) given.push_back(std::to_string(array.shape(axis)));
    for (std::size_t axis = 0; axis < extents.size(); ++axis) {
        const Extent& extent = extents.begin()[axis];
        expected.push_back(extent.shared != nullptr ? extent.shared->name : std::to_string(extent.fixed));
        fits = fits && (extent.shared != nullptr || static_cast<std::int64_t>(array.shape(axis)) == extent.fixed);
    }
    if (!fits)
        throw std::invalid_argument(name + " must have shape " + in_brackets(expected) + ", got " + in_brackets(given));
    for (std::size_t axis = 0; axis < extents.size(); ++axis) {
        Size* const size = extents.begin()[axis].shared;
        if (size == nullptr) continue;
        const auto value = static_cast<std::int64_t>(array.shape(axis));
        if (value > std::numeric_limits<std::int32_t>::max())
            throw std::invalid_argument(name + " has " + size->name + " = " + given[axis] +
                                        ", but must have less than 2^31");
        if (size->value < 0) {
            size->value = value;
            size->owner = name;
        }
        if (size->value != value)
            throw std::invalid_argument(name + " has " + size->name + " = " + given[axis] + ", but " + size->owner +
                                        " has " + size->name + " = " + std::to_string(size->value) +
                                        "; they must be the same");
    }
}

// Both ends are allowed.
inline void check_within(const std::string& name, std::int64_t value, std::int64_t low, std::int64_t high) {
    if (low <= value && value <= high) return;
    const std::string range = low == high ? std::to_string(low) : std::to_string(low) + " to " + std::to_string(high);
    throw std::invalid_argument(name + " must be " + range + ", got " + std::to_string(value));
}

// Of indices into the first axis of something with so many rows.
void check_indices(const std::string& name, const Array<const std::int32_t>& indices, std::int64_t rows);

// Of the places where one part after the other begins, the last one ending at `end`.
void check_begins(const std::string& name, const Array<const std::int64_t>& begins, std::int64_t end);

inline void check_threads(int threads) { check_within("threads", threads, 1, 1024); }  // as avatar/compute/native.py

}  // namespace avatar

template <typename T>
struct nanobind::detail::type_caster<avatar::Array<T>> {
    using Any = make_caster<typename avatar::Array<T>::Any>;
    NB_TYPE_CASTER(avatar::Array<T>, Any::Name)

    bool from_python(handle source, std::uint32_t flags, cleanup_list* cleanup) noexcept {
        if (const avatar::Lend lend = avatar::lender_of(Py_TYPE(source.ptr()))) {
            dlpack::dltensor lent;
            if (lend(source.ptr(), &lent) == 0) {
                if (lent.device.device_type != device::cpu::value || !avatar::is_in_c_order(lent) ||
                    lent.dtype != nanobind::dtype<std::remove_const_t<T>>())
                    return false;
                T* const data = reinterpret_cast<T*>(static_cast<char*>(lent.data) + lent.byte_offset);
                value = avatar::Array<T>(data, static_cast<std::size_t>(lent.ndim), lent.shape);
                return true;
            }
            PyErr_Clear();  // what cannot be lent is not taken the other way either, but told so there
        }
        Any any;
        if (!any.from_python(source, flags, cleanup)) return false;
        value = avatar::Array<T>(std::move(any.value));
        return true;
    }
};
