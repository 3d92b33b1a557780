// Vectors of W floats for a row of samples, and of 4 floats for one RGBA value.
// Plain IEEE operations in a fixed order: every variant of the core computes the same bits.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace ms {

#if defined(__AVX512F__)
constexpr int W = 16;
#elif defined(__AVX2__)
constexpr int W = 8;
#else
constexpr int W = 4;
#endif

typedef float vf __attribute__((vector_size(4 * W)));
typedef float f4 __attribute__((vector_size(16)));

inline vf set1(float a) { return a - vf{}; }
inline f4 set4(float a) { return f4{a, a, a, a}; }

inline vf load(const float *p) {
    vf v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
inline void store(float *p, vf v) { __builtin_memcpy(p, &v, sizeof v); }
inline f4 load4(const float *p) {
    f4 v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
inline void store4(float *p, f4 v) { __builtin_memcpy(p, &v, sizeof v); }

#if defined(__SSE2__)
inline f4 min4(f4 a, f4 b) { return _mm_min_ps(a, b); }
inline f4 max4(f4 a, f4 b) { return _mm_max_ps(a, b); }
#else
inline f4 min4(f4 a, f4 b) { return a < b ? a : b; }
inline f4 max4(f4 a, f4 b) { return a > b ? a : b; }
#endif

// Masks, one flag a lane.
#if defined(__AVX512F__)
typedef __mmask16 vm;
inline vm greater(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
inline vm equal(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ); }
inline vm not_less(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline vm both(vm a, vm b) { return a & b; }
inline unsigned bits(vm m) { return m; }
inline vf pick(vm m, vf yes, vf no) { return _mm512_mask_blend_ps(m, no, yes); }
inline vf add_where(vf a, vm m, vf b) { return _mm512_mask_add_ps(a, m, a, b); }
#else
typedef int vm __attribute__((vector_size(4 * W)));
inline vm greater(vf a, vf b) { return a > b; }
inline vm equal(vf a, vf b) { return a == b; }
inline vm not_less(vf a, vf b) { return a >= b; }
inline vm both(vm a, vm b) { return a & b; }
#if defined(__AVX2__)
inline unsigned bits(vm m) { return _mm256_movemask_ps((__m256)m); }
inline vf pick(vm m, vf yes, vf no) { return _mm256_blendv_ps(no, yes, (__m256)m); }
#else
#if defined(__SSE2__)
inline unsigned bits(vm m) { return _mm_movemask_ps((__m128)m); }
#else
inline unsigned bits(vm m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#endif
inline vf pick(vm m, vf yes, vf no) { return (vf)((m & (vm)yes) | (~m & (vm)no)); }
#endif
inline vf add_where(vf a, vm m, vf b) { return a + (vf)(m & (vm)b); }
#endif

// at_least(a, b): bit i is set where a[i] >= b[i].
#if defined(__AVX512F__)
inline vf vmin(vf a, vf b) { return _mm512_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm512_max_ps(a, b); }
inline unsigned at_least(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
#elif defined(__AVX2__)
inline vf vmin(vf a, vf b) { return _mm256_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm256_max_ps(a, b); }
inline unsigned at_least(vf a, vf b) { return _mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_GE_OQ)); }
#elif defined(__SSE2__)
inline vf vmin(vf a, vf b) { return _mm_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm_max_ps(a, b); }
inline unsigned at_least(vf a, vf b) { return _mm_movemask_ps(_mm_cmpge_ps(a, b)); }
#else
inline vf vmin(vf a, vf b) { return a < b ? a : b; }
inline vf vmax(vf a, vf b) { return a > b ? a : b; }
inline unsigned at_least(vf a, vf b) {
    auto m = a >= b;
    unsigned bits = 0;
    for (int i = 0; i < W; ++i) bits |= (unsigned)(m[i] & 1) << i;
    return bits;
}
#endif

// Writes the lanes of `v` whose bit is set next to each other from `out` on, which has room for W.
#if defined(__AVX512F__)
inline void compress(float *out, vf v, unsigned bits) { store(out, _mm512_maskz_compress_ps((__mmask16)bits, v)); }
#elif defined(__AVX2__)
struct CompressTable {
    alignas(32) unsigned char lane[256][8];
    constexpr CompressTable() : lane() {
        for (int bits = 0; bits < 256; ++bits) {
            int n = 0;
            for (int i = 0; i < 8; ++i)
                if (bits >> i & 1) lane[bits][n++] = (unsigned char)i;
        }
    }
};
constexpr CompressTable compress_table;
inline void compress(float *out, vf v, unsigned bits) {
    __m256i lane = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)compress_table.lane[bits]));
    _mm256_storeu_ps(out, _mm256_permutevar8x32_ps(v, lane));
}
#else
inline void compress(float *out, vf v, unsigned bits) {
    for (int i = 0; i < W; ++i)
        if (bits >> i & 1) *out++ = v[i];
}
#endif


// Writes first + lane for the lanes whose bit is set, next to each other; `out` has room for W.
inline void compress_numbers(int *out, int first, unsigned bits) {
    typedef int vi __attribute__((vector_size(4 * W)));
    static const vi lane = {0, 1, 2, 3,
#if defined(__AVX2__)
                            4, 5, 6, 7,
#endif
#if defined(__AVX512F__)
                            8, 9, 10, 11, 12, 13, 14, 15,
#endif
    };
    compress((float *)out, (vf)(lane + first), bits);
}

}  // namespace ms
