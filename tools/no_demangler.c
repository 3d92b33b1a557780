// For wheels. libc++abi contains a demangler, a fifth of the library, to print the type of an uncaught exception. No
// exception leaves the core, so this takes its place.
#include <stddef.h>

__attribute__((visibility("hidden"))) char *__cxa_demangle(const char *name, char *buffer, size_t *length,
                                                           int *status) {
    (void)name, (void)buffer, (void)length;
    if (status) *status = -2;  // "not a valid name"
    return NULL;
}
