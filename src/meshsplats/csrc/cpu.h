// Levels of the x86-64 instruction set that processor and operating system support, as the x86-64 psABI
// defines them (section 3.1.1, "Processor Architecture"). The builtins of compilers are not used: some
// runtimes, zig's for one, answer no to every question.
#pragma once

#if defined(__x86_64__)
#include <cpuid.h>

namespace ms {

// 1, 3 or 4: x86-64-v1, -v3 or -v4. Level 2 counts as 1, for the core has no variant between.
inline int x86_64_level() {
    const auto has = [](unsigned reg, unsigned bits) { return (reg & bits) == bits; };
    unsigned eax, ebx, basic_ecx, basic_edx, ecx, edx;

    if (!__get_cpuid(1, &eax, &ebx, &basic_ecx, &basic_edx)) return 1;
    const unsigned v2 = bit_SSE3 | bit_SSSE3 | bit_CMPXCHG16B | bit_SSE4_1 | bit_SSE4_2 | bit_POPCNT;
    const unsigned v3 = bit_FMA | bit_MOVBE | bit_OSXSAVE | bit_AVX | bit_F16C;
    if (!has(basic_ecx, v2 | v3)) return 1;

    if (!__get_cpuid(0x80000001, &eax, &ebx, &ecx, &edx)) return 1;
    if (!has(ecx, bit_LAHF_LM | bit_LZCNT)) return 1;

    if (!__get_cpuid_count(7, 0, &eax, &ebx, &ecx, &edx)) return 1;
    if (!has(ebx, bit_AVX2 | bit_BMI | bit_BMI2)) return 1;

    // XCR0: the register state that the operating system saves. Legal, because OSXSAVE is set.
    unsigned saved, saved_high;
    __asm__ volatile("xgetbv" : "=a"(saved), "=d"(saved_high) : "c"(0));
    const unsigned avx = 0x06, avx512 = 0xe6;  // SSE, YMM; and mask registers, upper ZMM, ZMM16 to ZMM31
    if (!has(saved, avx)) return 1;

    // macOS enables AVX-512 for a thread when it first uses it, and hides it until then: v3 is chosen there.
    const unsigned v4 = bit_AVX512F | bit_AVX512DQ | bit_AVX512CD | bit_AVX512BW | bit_AVX512VL;
    return has(ebx, v4) && has(saved, avx512) ? 4 : 3;
}

}  // namespace ms
#endif
