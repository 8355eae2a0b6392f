#pragma once
#include <cstddef>

namespace avatar {

// Memory for large tensors. An allocator gives blocks of their size back to the system, and the next one costs a page fault
// for every 4 KiB; so the block that was dropped last is kept for the next that has its size. And it asks the system for
// large pages, as walks through so much memory miss the table of small ones. May be called from any thread.
void* take_block(std::size_t bytes);  // uninitialised, aligned to 64 bytes; throws std::bad_alloc
void drop_block(void* block, std::size_t bytes) noexcept;

}  // namespace avatar
