// Assertions for builds with -DMS_CHECKS; without it MS_ASSERT costs nothing.
#pragma once

#if defined(MS_CHECKS)

#include <cstdio>
#include <cstdlib>

namespace ms {

[[noreturn]] inline void assertion_failed(const char *condition, const char *file, int line) {
    std::fprintf(stderr, "%s:%d: assertion failed: %s\n", file, line, condition);
    std::abort();
}

}  // namespace ms

#define MS_ASSERT(condition) ((condition) ? (void)0 : ::ms::assertion_failed(#condition, __FILE__, __LINE__))

#else

// sizeof does not evaluate its operand, but counts as a use of its variables.
#define MS_ASSERT(condition) ((void)sizeof((condition) ? 1 : 0))

#endif
