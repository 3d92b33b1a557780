// Large arrays from a process-wide pool of huge-page memory.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#include "check.h"

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ms {

// Keeps freed memory for the next image: the system hands out zeroed pages, and zeroing them takes longer
// than using them. Thread-safe. Not used with the address sanitizer, which has to see every allocation.
class MemoryPool {
  public:
    static constexpr std::size_t HUGE_PAGE = (std::size_t)2 << 20;
    static constexpr std::size_t MIN_POOLED = (std::size_t)64 << 10;  // smaller allocations bypass the pool
    static constexpr std::size_t MAX_CACHED = (std::size_t)256 << 20;
#if defined(__SANITIZE_ADDRESS__)
    static constexpr bool ENABLED = false;
#else
    static constexpr bool ENABLED = true;
#endif

    static void *allocate(std::size_t bytes) {
        if (!ENABLED || bytes < MIN_POOLED) return ::operator new(bytes, std::align_val_t(SMALL_ALIGNMENT));
        const std::size_t size = size_class(bytes);
        if (void *p = pool().take_cached(size)) return p;
        void *p = ::operator new(size, std::align_val_t(alignment_of(size)));
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        // Random accesses then miss the TLB less often. Failure does not matter: pages stay small.
        if (size >= HUGE_PAGE) madvise(p, size, MADV_HUGEPAGE);
#endif
        return p;
    }

    // `bytes` must be the size that was allocated.
    static void deallocate(void *p, std::size_t bytes) noexcept {
        if (!ENABLED || bytes < MIN_POOLED) return ::operator delete(p, std::align_val_t(SMALL_ALIGNMENT));
        const std::size_t size = size_class(bytes);
        if (size > MAX_CACHED) return release(p, size);
        pool().cache(p, size);
    }

  private:
    static constexpr std::size_t SMALL_ALIGNMENT = 64;

    struct Chunk {
        void *p;
        std::size_t size;
    };

    // Never destroyed, because arrays may outlive static objects.
    static MemoryPool &pool() {
        static MemoryPool *pool = new MemoryPool;
        return *pool;
    }
    // Rounds up by at most an eighth, so that the next image of about the same size fits.
    static std::size_t size_class(std::size_t bytes) {
        std::size_t step = MIN_POOLED / 8;
        while (step * 16 <= bytes) step *= 2;
        const std::size_t size = (bytes + step - 1) / step * step;
        MS_ASSERT(size >= bytes && size - bytes <= bytes / 8);
        return size;
    }
    static std::size_t alignment_of(std::size_t size) {
        return size < HUGE_PAGE ? SMALL_ALIGNMENT : HUGE_PAGE;
    }
    static void release(void *p, std::size_t size) noexcept {
        ::operator delete(p, std::align_val_t(alignment_of(size)));
    }

    // Memory of exactly this size, the most recently used first; null if there is none.
    void *take_cached(std::size_t size) {
        std::lock_guard<std::mutex> lock(mutex_);
        for (std::size_t i = chunks_.size(); i-- > 0;) {
            if (chunks_[i].size != size) continue;
            void *p = chunks_[i].p;
            chunks_.erase(chunks_.begin() + i);
            cached_bytes_ -= size;
            return p;
        }
        return nullptr;
    }

    void cache(void *p, std::size_t size) noexcept {
        std::lock_guard<std::mutex> lock(mutex_);
        // A full cache holds sizes that are no longer in use: evict all of it.
        if (cached_bytes_ + size > MAX_CACHED) evict_all();
        try {
            chunks_.push_back({p, size});
            cached_bytes_ += size;
        } catch (const std::bad_alloc &) {
            release(p, size);
        }
    }
    void evict_all() noexcept {
        for (const Chunk &chunk : chunks_) release(chunk.p, chunk.size);
        chunks_.clear();
        cached_bytes_ = 0;
    }

    std::mutex mutex_;
    std::vector<Chunk> chunks_;  // not in use
    std::size_t cached_bytes_ = 0;
};

template <class T>
struct PoolAllocator {
    using value_type = T;

    PoolAllocator() = default;
    template <class U>
    PoolAllocator(const PoolAllocator<U> &) {}
    T *allocate(std::size_t n) { return (T *)MemoryPool::allocate(n * sizeof(T)); }
    void deallocate(T *p, std::size_t n) noexcept { MemoryPool::deallocate(p, n * sizeof(T)); }
    // Default-initialises: resize() leaves numbers uninitialised, because they are about to be written
    // anyway.
    template <class U>
    void construct(U *p) {
        ::new ((void *)p) U;
    }
    template <class U, class... Arguments>
    void construct(U *p, Arguments &&...arguments) {
        ::new ((void *)p) U(std::forward<Arguments>(arguments)...);
    }
    template <class U>
    bool operator==(const PoolAllocator<U> &) const {
        return true;
    }
    template <class U>
    bool operator!=(const PoolAllocator<U> &) const {
        return false;
    }
};

// A vector whose resize() does not zero numbers.
template <class T>
using PooledVector = std::vector<T, PoolAllocator<T>>;

}  // namespace ms
