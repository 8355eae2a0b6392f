#include "python/large_tensor.h"

#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <string>

#include "block_store.h"

namespace nb = nanobind;

namespace avatar {
namespace {

constexpr std::size_t kMostBytes = std::size_t{1} << 46;  // of a process on today's processors

struct Block {
    explicit Block(std::size_t size) : bytes(size), data(take_block(size)) {}
    ~Block() { drop_block(data, bytes); }
    Block(const Block&) = delete;
    Block& operator=(const Block&) = delete;

    std::size_t bytes;
    void* data;
};

}  // namespace

Tensor large_tensor(const std::vector<std::size_t>& shape) {
    std::size_t bytes = sizeof(float);
    bool too_many = false;
    for (const std::size_t side : shape) too_many |= __builtin_mul_overflow(bytes, side, &bytes);
    if (too_many || bytes > kMostBytes)
        throw std::length_error("a tensor of this shape would need more than " + std::to_string(kMostBytes >> 40) +
                                " TiB of memory");
    auto block = std::make_unique<Block>(bytes);
    const nb::capsule owner(block.get(), [](void* p) noexcept { delete static_cast<Block*>(p); });
    void* const data = block.release()->data;
    return Tensor(data, shape.size(), shape.data(), owner);
}

}  // namespace avatar

void bind_large_tensor(nb::module_& m) { m.def("large_tensor", &avatar::large_tensor, nb::arg("shape")); }
