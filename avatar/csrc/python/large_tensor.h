#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <vector>

namespace avatar {

using Tensor = nanobind::ndarray<nanobind::pytorch, float, nanobind::c_contig, nanobind::device::cpu>;

// An uninitialised tensor in memory from block_store.h, which goes back there when torch has no use for it any more.
Tensor large_tensor(const std::vector<std::size_t>& shape);

}  // namespace avatar
