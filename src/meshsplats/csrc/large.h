// Memory for large arrays, most of which are read in no order.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ms {

// Blocks that the last picture needed and the next one will need again: a system gives memory as zeros, page
// by page, which takes longer than writing to it.
class Blocks {
  public:
    static constexpr std::size_t PAGE = (std::size_t)2 << 20;
    static constexpr std::size_t SMALLEST = (std::size_t)64 << 10;  // what is smaller is not kept
    static constexpr std::size_t MOST = (std::size_t)256 << 20;     // bytes kept

    static void *take(std::size_t bytes) {
        if (bytes < SMALLEST) return ::operator new(bytes, std::align_val_t(64));
        const std::size_t size = rounded(bytes);
        {
            Blocks &all = kept();
            std::lock_guard<std::mutex> lock(all.guard_);
            for (std::size_t i = all.blocks_.size(); i-- > 0;) {
                if (all.blocks_[i].size != size) continue;
                void *p = all.blocks_[i].p;
                all.blocks_.erase(all.blocks_.begin() + i);
                all.bytes_ -= size;
                return p;
            }
        }
        if (size < PAGE) return ::operator new(size, std::align_val_t(64));
        void *p = ::operator new(size, std::align_val_t(PAGE));
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        // With small pages, every access far from the last waits for the page's address too. (This is advice:
        // where it is not taken, pages stay small.)
        madvise(p, size, MADV_HUGEPAGE);
#endif
        return p;
    }

    static void give(void *p, std::size_t bytes) noexcept {
        if (bytes < SMALLEST) return ::operator delete(p, std::align_val_t(64));
        const std::size_t size = rounded(bytes);
        if (size > MOST) return release(p, size);
        Blocks &all = kept();
        std::lock_guard<std::mutex> lock(all.guard_);
        // What no longer fits makes room for what is in use now.
        if (all.bytes_ + size > MOST) all.drop();
        try {
            all.blocks_.push_back({p, size});
            all.bytes_ += size;
        } catch (const std::bad_alloc &) {
            release(p, size);
        }
    }

  private:
    struct Block {
        void *p;
        std::size_t size;
    };

    // Never destroyed: arrays may live longer than what is static.
    static Blocks &kept() {
        static Blocks *blocks = new Blocks;
        return *blocks;
    }
    // Up to an eighth more, so that pictures that need about as much find it.
    static std::size_t rounded(std::size_t bytes) {
        std::size_t step = SMALLEST / 8;
        while (step * 16 <= bytes) step *= 2;
        return (bytes + step - 1) / step * step;
    }
    static void release(void *p, std::size_t size) noexcept {
        ::operator delete(p, std::align_val_t(size < PAGE ? 64 : PAGE));
    }
    void drop() noexcept {
        for (const Block &block : blocks_) release(block.p, block.size);
        blocks_.clear();
        bytes_ = 0;
    }

    std::mutex guard_;
    std::vector<Block> blocks_;
    std::size_t bytes_ = 0;
};

template <class T>
struct LargeMemory {
    using value_type = T;

    LargeMemory() = default;
    template <class U>
    LargeMemory(const LargeMemory<U> &) {}
    T *allocate(std::size_t n) { return (T *)Blocks::take(n * sizeof(T)); }
    void deallocate(T *p, std::size_t n) noexcept { Blocks::give(p, n * sizeof(T)); }
    // Numbers that are about to be written are not written as zeros first, by one thread.
    template <class U>
    void construct(U *p) {
        ::new ((void *)p) U;
    }
    template <class U, class... Given>
    void construct(U *p, Given &&...given) {
        ::new ((void *)p) U(std::forward<Given>(given)...);
    }
    template <class U>
    bool operator==(const LargeMemory<U> &) const {
        return true;
    }
    template <class U>
    bool operator!=(const LargeMemory<U> &) const {
        return false;
    }
};

template <class T>
using Large = std::vector<T, LargeMemory<T>>;

}  // namespace ms
