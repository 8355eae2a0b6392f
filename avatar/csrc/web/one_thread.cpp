// thread_pool.h where there is one thread: a browser's worker.
#include <algorithm>

#include "thread_pool.h"

namespace avatar {

void parallel_for(int, std::int64_t count, std::int64_t grain,
                  const std::function<void(std::int64_t, std::int64_t)>& body) {
    for (std::int64_t begin = 0; begin < count; begin += grain) body(begin, std::min(begin + grain, count));
}

}  // namespace avatar
