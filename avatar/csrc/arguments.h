#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <initializer_list>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

// What the compiled functions demand of their arguments, so that none can read or write beyond an array. The order of its
// values, its type and its device are demanded by the type Array; ranks and sizes here, in the words of avatar/check.py.
// Indices that arrays hold are not looked at again: who makes them in Python keeps them in range.
namespace avatar {

template <typename T>
using Array = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu>;

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

inline void check_threads(int threads) { check_within("threads", threads, 1, 1024); }  // as avatar/native.py

}  // namespace avatar
