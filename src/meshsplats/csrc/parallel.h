// Work sharing over std::thread. Items are taken one by one from a counter, so threads never wait for each
// other.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace ms {

// Calls work(thread number) on `threads` threads; an exception in one is thrown again here once all have
// ended.
template <class Work>
void on_threads(int threads, Work work) {
    if (threads <= 1) return work(0);
    std::exception_ptr failure;
    std::mutex guard;
    auto run = [&](int number) {
        try {
            work(number);
        } catch (...) {
            std::lock_guard<std::mutex> lock(guard);
            if (!failure) failure = std::current_exception();
        }
    };
    std::vector<std::thread> pool;
    pool.reserve(threads - 1);
    int started = 1;
    try {
        for (; started < threads; ++started) pool.emplace_back(run, started);
    } catch (...) {
        // The system gives no more threads: this one does the others' share too.
    }
    run(0);
    for (int number = started; number < threads; ++number) run(number);
    for (auto &t : pool) t.join();
    if (failure) std::rethrow_exception(failure);
}

// Calls body(begin, end, thread) on consecutive blocks of [0, count).
template <class Body>
void parallel_blocks(int threads, int64_t count, int64_t block, Body body) {
    std::atomic<int64_t> next{0};
    threads = (int)std::max<int64_t>(1, std::min<int64_t>(threads, (count + block - 1) / block));
    on_threads(threads, [&](int thread) {
        for (;;) {
            int64_t begin = next.fetch_add(block);
            if (begin >= count) return;
            body(begin, std::min(count, begin + block), thread);
        }
    });
}

}  // namespace ms
