#include "python/large_tensor.h"

#include <nanobind/stl/vector.h>

#include <functional>
#include <memory>
#include <numeric>

#include "block_store.h"

namespace nb = nanobind;

namespace avatar {
namespace {

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
    const std::size_t values = std::accumulate(shape.begin(), shape.end(), std::size_t{1}, std::multiplies<>());
    auto block = std::make_unique<Block>(values * sizeof(float));
    const nb::capsule owner(block.get(), [](void* p) noexcept { delete static_cast<Block*>(p); });
    void* const data = block.release()->data;
    return Tensor(data, shape.size(), shape.data(), owner);
}

}  // namespace avatar

void bind_large_tensor(nb::module_& m) { m.def("large_tensor", &avatar::large_tensor, nb::arg("shape")); }
