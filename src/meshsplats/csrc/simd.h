// SIMD vectors: vf holds W floats, the native width; vd holds WD doubles; f4 holds one RGBA value.
// All operations are IEEE operations in a fixed order, so every variant of the core computes the same bits;
// mul_add and reciprocal are the exceptions.
#pragma once

#include <cstdint>

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
constexpr int WD = W > 4 ? 4 : 2;  // eight are no faster than four

typedef float vf __attribute__((vector_size(4 * W)));
typedef double vd __attribute__((vector_size(8 * WD)));
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

// v if `keep`, else 0, even if v is NaN.
inline f4 masked4(bool keep, f4 v) {
    typedef int i4 __attribute__((vector_size(16)));
    const int mask = -(int)keep;
    return (f4)((i4)v & i4{mask, mask, mask, mask});
}

#if defined(__SSE2__)
inline f4 min4(f4 a, f4 b) { return _mm_min_ps(a, b); }
inline f4 max4(f4 a, f4 b) { return _mm_max_ps(a, b); }
#else
inline f4 min4(f4 a, f4 b) { return a < b ? a : b; }
inline f4 max4(f4 a, f4 b) { return a > b ? a : b; }
#endif

// a b + c, fused where the processor has FMA. Only for results that may differ between variants.
#if defined(__AVX512F__)
inline vf mul_add(vf a, vf b, vf c) { return _mm512_fmadd_ps(a, b, c); }
#elif defined(__FMA__) && defined(__AVX2__)
inline vf mul_add(vf a, vf b, vf c) { return _mm256_fmadd_ps(a, b, c); }
#else
inline vf mul_add(vf a, vf b, vf c) { return a * b + c; }
#endif

// 1 / a for normal a, within 2 ulp: estimate and one Newton step with AVX-512, else a division. Only for
// results that may differ between variants.
#if defined(__AVX512F__)
inline vf reciprocal(vf a) {
    const vf r = _mm512_rcp14_ps(a);
    return _mm512_fmadd_ps(r, _mm512_fnmadd_ps(a, r, set1(1)), r);
}
#else
inline vf reciprocal(vf a) { return 1 / a; }
#endif

// Square roots, rounded as IEEE demands.
#if defined(__AVX512F__)
inline vf vsqrt(vf a) { return _mm512_sqrt_ps(a); }
#elif defined(__AVX2__)
inline vf vsqrt(vf a) { return _mm256_sqrt_ps(a); }
#elif defined(__SSE2__)
inline vf vsqrt(vf a) { return _mm_sqrt_ps(a); }
#else
inline vf vsqrt(vf a) {
    for (int i = 0; i < W; ++i) a[i] = __builtin_sqrtf(a[i]);
    return a;
}
#endif

// Integers beside the floats, for indices: truncated floats, and the words at these indices.
typedef int vi __attribute__((vector_size(4 * W)));
inline vi truncated(vf a) { return __builtin_convertvector(a, vi); }
inline vf as_floats(vi a) { return __builtin_convertvector(a, vf); }
#if defined(__AVX512F__)
inline vi gather(const uint32_t *words, vi index) {
    return (vi)_mm512_i32gather_epi32((__m512i)index, words, 4);
}
#elif defined(__AVX2__)
inline vi gather(const uint32_t *words, vi index) {
    return (vi)_mm256_i32gather_epi32((const int *)words, (__m256i)index, 4);
}
#else
inline vi gather(const uint32_t *words, vi index) {
    vi result{};
    for (int i = 0; i < W; ++i) result[i] = (int)words[index[i]];
    return result;
}
#endif

// Masks: one flag per lane. Comparisons with NaN are false.
#if defined(__AVX512F__)
typedef __mmask16 vm;
inline vm greater(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
inline vm equal(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ); }
inline vm greater_equal(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline vm mask_and(vm a, vm b) { return a & b; }
inline vm mask_not(vm a) { return ~a; }
inline unsigned bits(vm m) { return m; }
inline vf select(vm m, vf yes, vf no) { return _mm512_mask_blend_ps(m, no, yes); }
inline vf add_where(vf a, vm m, vf b) { return _mm512_mask_add_ps(a, m, a, b); }
#else
typedef int vm __attribute__((vector_size(4 * W)));
inline vm greater(vf a, vf b) { return a > b; }
inline vm equal(vf a, vf b) { return a == b; }
inline vm greater_equal(vf a, vf b) { return a >= b; }
inline vm mask_and(vm a, vm b) { return a & b; }
inline vm mask_not(vm a) { return ~a; }
#if defined(__AVX2__)
inline unsigned bits(vm m) { return _mm256_movemask_ps((__m256)m); }
inline vf select(vm m, vf yes, vf no) { return _mm256_blendv_ps(no, yes, (__m256)m); }
#else
#if defined(__SSE2__)
inline unsigned bits(vm m) { return _mm_movemask_ps((__m128)m); }
#else
inline unsigned bits(vm m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#endif
inline vf select(vm m, vf yes, vf no) { return (vf)((m & (vm)yes) | (~m & (vm)no)); }
#endif
inline vf add_where(vf a, vm m, vf b) { return a + (vf)(m & (vm)b); }
#endif

// If an operand of vmin or vmax is NaN, the result is b. Bit i of greater_equal_bits says a[i] >= b[i].
#if defined(__AVX512F__)
inline vf vmin(vf a, vf b) { return _mm512_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm512_max_ps(a, b); }
inline unsigned greater_equal_bits(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
#elif defined(__AVX2__)
inline vf vmin(vf a, vf b) { return _mm256_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm256_max_ps(a, b); }
inline unsigned greater_equal_bits(vf a, vf b) { return _mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_GE_OQ)); }
#elif defined(__SSE2__)
inline vf vmin(vf a, vf b) { return _mm_min_ps(a, b); }
inline vf vmax(vf a, vf b) { return _mm_max_ps(a, b); }
inline unsigned greater_equal_bits(vf a, vf b) { return _mm_movemask_ps(_mm_cmpge_ps(a, b)); }
#else
inline vf vmin(vf a, vf b) { return a < b ? a : b; }
inline vf vmax(vf a, vf b) { return a > b ? a : b; }
inline unsigned greater_equal_bits(vf a, vf b) {
    auto m = a >= b;
    unsigned bits = 0;
    for (int i = 0; i < W; ++i) bits |= (unsigned)(m[i] & 1) << i;
    return bits;
}
#endif

// mask_of: the mask of the lanes whose bit is set. masked: v in the lanes of the mask, 0 elsewhere.
#if defined(__AVX512F__)
inline vm mask_of(unsigned bits) { return (__mmask16)bits; }
inline vf masked(vm m, vf v) { return _mm512_maskz_mov_ps(m, v); }
#else
inline vm mask_of(unsigned bits) {
#if defined(__AVX2__)
    const vm flag = {1, 2, 4, 8, 16, 32, 64, 128};
#else
    const vm flag = {1, 2, 4, 8};
#endif
    return (((int)bits - vm{}) & flag) == flag;
}
inline vf masked(vm m, vf v) { return (vf)(m & (vm)v); }
#endif

// The first four elements of WD rows: columns[i][j] = rows[j][i].
#if defined(__AVX2__)
inline void transpose(const double *const rows[WD], vd columns[4]) {
    const vd r0 = _mm256_loadu_pd(rows[0]), r1 = _mm256_loadu_pd(rows[1]), r2 = _mm256_loadu_pd(rows[2]),
             r3 = _mm256_loadu_pd(rows[3]);
    const vd low01 = _mm256_unpacklo_pd(r0, r1), high01 = _mm256_unpackhi_pd(r0, r1),
             low23 = _mm256_unpacklo_pd(r2, r3), high23 = _mm256_unpackhi_pd(r2, r3);
    columns[0] = _mm256_permute2f128_pd(low01, low23, 0x20);
    columns[1] = _mm256_permute2f128_pd(high01, high23, 0x20);
    columns[2] = _mm256_permute2f128_pd(low01, low23, 0x31);
    columns[3] = _mm256_permute2f128_pd(high01, high23, 0x31);
}
#else
inline void transpose(const double *const rows[WD], vd columns[4]) {
    for (int i = 0; i < 4; ++i) columns[i] = vd{rows[0][i], rows[1][i]};
}
#endif

}  // namespace ms
