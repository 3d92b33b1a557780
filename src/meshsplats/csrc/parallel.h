// Parallel loops over std::thread with dynamic scheduling: threads fetch work from an atomic counter.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

#include "check.h"

namespace ms {

// Of the call that a thread works for: not 0 once it is to end. Null: nobody asks it to.
inline thread_local const int32_t *stop_flag = nullptr;

struct Stopped : std::exception {
    const char *what() const noexcept override { return "stopped"; }
};

// Between pieces of work of less than a second: ends the call if it is to end.
inline void stop_point() {
    if (stop_flag && __atomic_load_n(stop_flag, __ATOMIC_RELAXED)) throw Stopped();
}

// Calls work(thread) once for each thread index in [0, threads), in parallel. Joins all threads, then
// rethrows the first exception.
inline void on_threads(int threads, const std::function<void(int)> &work) {
    MS_ASSERT(threads >= 1);
    if (threads <= 1) return work(0);
    std::exception_ptr failure;
    std::mutex failure_mutex;
    auto run = [&, flag = stop_flag](int thread) {
        stop_flag = flag;
        try {
            work(thread);
        } catch (...) {
            std::lock_guard<std::mutex> lock(failure_mutex);
            if (!failure) failure = std::current_exception();
        }
    };
    std::vector<std::thread> pool;
    pool.reserve(threads - 1);
    int started = 1;
    try {
        for (; started < threads; ++started) pool.emplace_back(run, started);
    } catch (...) {
        // The system refuses more threads: this thread also does the work of the missing ones.
    }
    run(0);
    for (int thread = started; thread < threads; ++thread) run(thread);
    for (auto &t : pool) t.join();
    if (failure) std::rethrow_exception(failure);
}

// Calls body(begin, end, thread) for consecutive blocks of at most `block` indices that cover [0, count).
template <class Body>
void parallel_blocks(int threads, int64_t count, int64_t block, Body body) {
    MS_ASSERT(count >= 0 && block >= 1);
    std::atomic<int64_t> next{0};
    threads = (int)std::max<int64_t>(1, std::min<int64_t>(threads, (count + block - 1) / block));
    on_threads(threads, [&](int thread) {
        for (;;) {
            int64_t begin = next.fetch_add(block);
            if (begin >= count) return;
            stop_point();
            body(begin, std::min(count, begin + block), thread);
        }
    });
}

}  // namespace ms
