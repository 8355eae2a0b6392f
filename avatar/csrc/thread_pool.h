#pragma once
#include <cstdint>
#include <functional>

namespace avatar {

// Calls body(begin, end) over disjoint ranges of at most `grain` that cover [0, count), on up to `threads` threads
// including the calling one, and returns when all are done. Which thread runs which range is not defined, so a body
// must write only to places that belong to its range. The first exception of a body is thrown again here.
//
// The workers are the process's own (not OpenMP's, whose second runtime beside torch's would fight for the cores); they
// are started when first needed and survive a fork by being started again. A call made while another one is running
// is done by its calling thread alone.
void parallel_for(int threads, std::int64_t count, std::int64_t grain,
                  const std::function<void(std::int64_t, std::int64_t)>& body);

}  // namespace avatar
