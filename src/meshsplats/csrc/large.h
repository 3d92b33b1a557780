// Arrays that are read in no order of memory.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ms {

// Asks for large pages: with small ones, every access far from the last waits for the page's address too.
template <class T>
struct LargePages {
    using value_type = T;
    static constexpr std::size_t PAGE = (std::size_t)2 << 20;

    LargePages() = default;
    template <class U>
    LargePages(const LargePages<U> &) {}
    T *allocate(std::size_t n) {
        const std::size_t bytes = n * sizeof(T);
        if (bytes < PAGE) return (T *)::operator new(bytes, std::align_val_t(64));
        void *p = ::operator new(bytes, std::align_val_t(PAGE));
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        madvise(p, bytes, MADV_HUGEPAGE);  // advice: where it is not taken, pages stay small
#endif
        return (T *)p;
    }
    void deallocate(T *p, std::size_t n) {
        ::operator delete(p, std::align_val_t(n * sizeof(T) < PAGE ? 64 : PAGE));
    }
    // Numbers that are about to be written are not written as zeros first, by one thread.
    template <class U>
    void construct(U *p) { ::new ((void *)p) U; }
    template <class U, class... Given>
    void construct(U *p, Given &&...given) { ::new ((void *)p) U(std::forward<Given>(given)...); }
    template <class U>
    bool operator==(const LargePages<U> &) const { return true; }
    template <class U>
    bool operator!=(const LargePages<U> &) const { return false; }
};

template <class T>
using Large = std::vector<T, LargePages<T>>;

}  // namespace ms
