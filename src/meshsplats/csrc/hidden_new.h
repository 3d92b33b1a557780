// operator new and delete of our own on macOS, not exported. The static libc++ in a wheel would export its
// own, and dyld would then share one definition among all libraries of the process.
#pragma once

#if defined(__APPLE__)
#include <cstddef>
#include <cstdlib>
#include <new>

// The names are those of the C++ ABI, for the compiler gives its own declarations default visibility.
#define MS_HIDDEN(symbol) __asm__(symbol) __attribute__((visibility("hidden"), used))

extern "C" {

void *ms_new(std::size_t size) MS_HIDDEN("__Znwm");
void *ms_new_array(std::size_t size) MS_HIDDEN("__Znam");
void *ms_new_aligned(std::size_t size, std::size_t alignment) MS_HIDDEN("__ZnwmSt11align_val_t");
void *ms_new_array_aligned(std::size_t size, std::size_t alignment) MS_HIDDEN("__ZnamSt11align_val_t");
void ms_delete(void *memory) MS_HIDDEN("__ZdlPv");
void ms_delete_array(void *memory) MS_HIDDEN("__ZdaPv");
void ms_delete_sized(void *memory, std::size_t) MS_HIDDEN("__ZdlPvm");
void ms_delete_array_sized(void *memory, std::size_t) MS_HIDDEN("__ZdaPvm");
void ms_delete_aligned(void *memory, std::size_t) MS_HIDDEN("__ZdlPvSt11align_val_t");
void ms_delete_array_aligned(void *memory, std::size_t) MS_HIDDEN("__ZdaPvSt11align_val_t");
void ms_delete_sized_aligned(void *memory, std::size_t, std::size_t) MS_HIDDEN("__ZdlPvmSt11align_val_t");
void ms_delete_array_sized_aligned(void *memory, std::size_t, std::size_t)
    MS_HIDDEN("__ZdaPvmSt11align_val_t");

void *ms_new(std::size_t size) {
    void *memory = std::malloc(size ? size : 1);
    if (!memory) throw std::bad_alloc();
    return memory;
}

void *ms_new_aligned(std::size_t size, std::size_t alignment) {
    void *memory = nullptr;
    if (alignment < sizeof(void *)) alignment = sizeof(void *);
    if (posix_memalign(&memory, alignment, size ? size : 1)) throw std::bad_alloc();
    return memory;
}

void *ms_new_array(std::size_t size) { return ms_new(size); }
void *ms_new_array_aligned(std::size_t size, std::size_t alignment) {
    return ms_new_aligned(size, alignment);
}
void ms_delete(void *memory) { std::free(memory); }
void ms_delete_array(void *memory) { std::free(memory); }
void ms_delete_sized(void *memory, std::size_t) { std::free(memory); }
void ms_delete_array_sized(void *memory, std::size_t) { std::free(memory); }
void ms_delete_aligned(void *memory, std::size_t) { std::free(memory); }
void ms_delete_array_aligned(void *memory, std::size_t) { std::free(memory); }
void ms_delete_sized_aligned(void *memory, std::size_t, std::size_t) { std::free(memory); }
void ms_delete_array_sized_aligned(void *memory, std::size_t, std::size_t) { std::free(memory); }

}  // extern "C"

#undef MS_HIDDEN
#endif
