#include "block_store.h"

#include <sys/mman.h>

#include <cstdlib>
#include <mutex>
#include <new>
#include <utility>

namespace avatar {
namespace {

constexpr std::size_t kLargePage = std::size_t{1} << 21;

struct Store {
    std::mutex mutex;
    void* idle = nullptr;
    std::size_t bytes = 0;
};

// Never destroyed: blocks may be dropped while the process ends.
Store& store() {
    static Store* const only = new Store;
    return *only;
}

}  // namespace

void* take_block(std::size_t bytes) {
    void* unfit = nullptr;
    {
        const std::lock_guard lock(store().mutex);
        void* const idle = std::exchange(store().idle, nullptr);
        if (idle != nullptr && store().bytes == bytes) return idle;
        unfit = idle;
    }
    std::free(unfit);
    const std::size_t alignment = bytes < kLargePage ? 64 : kLargePage;
    void* const block = std::aligned_alloc(alignment, (bytes / alignment + 1) * alignment);
    if (block == nullptr) throw std::bad_alloc();
#ifdef MADV_HUGEPAGE
    if (bytes >= kLargePage) madvise(block, bytes, MADV_HUGEPAGE);  // no matter if the system has none
#endif
    return block;
}

void drop_block(void* block, std::size_t bytes) noexcept {
    {
        const std::lock_guard lock(store().mutex);
        std::swap(store().idle, block);
        store().bytes = bytes;
    }
    std::free(block);
}

}  // namespace avatar
