#include "thread_pool.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>

namespace avatar {
namespace {

struct Job {
    const std::function<void(std::int64_t, std::int64_t)>& body;
    std::int64_t count, grain;
    std::atomic<std::int64_t> next{0};
    std::mutex error_mutex;
    std::exception_ptr error;

    void work() {
        for (;;) {
            const std::int64_t begin = next.fetch_add(grain);
            if (begin >= count) return;
            try {
                body(begin, std::min(begin + grain, count));
            } catch (...) {
                const std::lock_guard lock(error_mutex);
                if (!error) error = std::current_exception();
            }
        }
    }
};

class Pool {
public:
    // False when another call has the pool.
    bool run(Job& job, int helpers) {
        const std::unique_lock one_caller(caller_mutex_, std::try_to_lock);
        if (!one_caller) return false;
        std::unique_lock lock(mutex_);
        for (; workers_ < helpers; ++workers_) std::thread([this] { loop(); }).detach();
        job_ = &job;
        openings_ = helpers;
        lock.unlock();
        for (int i = 0; i < helpers; ++i) start_.notify_one();

        job.work();

        lock.lock();
        job_ = nullptr;  // a worker that wakes up only now has nothing to join
        openings_ = 0;
        done_.wait(lock, [this] { return joined_ == 0; });
        return true;
    }

private:
    void loop() {
        std::unique_lock lock(mutex_);
        for (;;) {
            start_.wait(lock, [this] { return openings_ > 0; });
            --openings_;
            ++joined_;
            Job& job = *job_;
            lock.unlock();
            job.work();
            lock.lock();
            if (--joined_ == 0) done_.notify_one();
        }
    }

    std::mutex caller_mutex_, mutex_;
    std::condition_variable start_, done_;
    Job* job_ = nullptr;
    int workers_ = 0, openings_ = 0, joined_ = 0;
};

// The pool lives until the process ends: its workers may wait in it while static objects are destroyed. The threads of
// a parent do not exist in a forked child, so a child makes its own.
Pool& process_pool() {
    static std::mutex mutex;
    static Pool* pool = nullptr;
    static pid_t owner = 0;
    const std::lock_guard lock(mutex);
    if (pool == nullptr || owner != getpid()) {
        pool = new Pool;
        owner = getpid();
    }
    return *pool;
}

}  // namespace

void parallel_for(int threads, std::int64_t count, std::int64_t grain,
                  const std::function<void(std::int64_t, std::int64_t)>& body) {
    if (count <= 0) return;
    const std::int64_t ranges = (count + grain - 1) / grain;
    const int helpers = static_cast<int>(std::min<std::int64_t>(threads, ranges)) - 1;
    Job job{body, count, grain, {}, {}, {}};
    if (helpers <= 0 || !process_pool().run(job, helpers)) job.work();
    if (job.error) std::rethrow_exception(job.error);
}

}  // namespace avatar
