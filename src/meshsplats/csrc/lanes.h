// The 16 samples of a block, one number each. Operations are those of the vectors they consist of, in the same order
// at every vector width.
#pragma once

#include "simd.h"

namespace ms {

constexpr int LANES = 16, PARTS = LANES / W;

struct Lanes {
    vf part[PARTS];
};

inline Lanes lanes(float a) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = set1(a);
    return r;
}
inline Lanes load_lanes(const float *p) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = load(p + i * W);
    return r;
}
inline void store_lanes(float *p, const Lanes &a) {
    for (int i = 0; i < PARTS; ++i) store(p + i * W, a.part[i]);
}

#define MS_LANES(name, expression)                                    \
    inline Lanes name(const Lanes &a, const Lanes &b) {               \
        Lanes r;                                                      \
        for (int i = 0; i < PARTS; ++i) {                             \
            const vf x = a.part[i], y = b.part[i];                    \
            r.part[i] = expression;                                   \
        }                                                             \
        return r;                                                     \
    }
MS_LANES(operator+, x + y)
MS_LANES(operator-, x - y)
MS_LANES(operator*, x * y)
MS_LANES(operator/, x / y)
MS_LANES(least, vmin(x, y))
MS_LANES(most, vmax(x, y))
#undef MS_LANES

// Limits a to [low, high]; NaN becomes low.
inline Lanes clamp(const Lanes &a, const Lanes &low, const Lanes &high) { return least(most(a, low), high); }

// One bit a lane: where a > b, a >= b, a == b.
inline unsigned greater(const Lanes &a, const Lanes &b) {
    unsigned r = 0;
    for (int i = 0; i < PARTS; ++i) r |= bits(greater(a.part[i], b.part[i])) << i * W;
    return r;
}
inline unsigned at_least(const Lanes &a, const Lanes &b) {
    unsigned r = 0;
    for (int i = 0; i < PARTS; ++i) r |= at_least(a.part[i], b.part[i]) << i * W;
    return r;
}
inline unsigned equal(const Lanes &a, const Lanes &b) {
    unsigned r = 0;
    for (int i = 0; i < PARTS; ++i) r |= bits(equal(a.part[i], b.part[i])) << i * W;
    return r;
}

// The lanes whose bit is set; 0 in the others.
inline Lanes only(unsigned chosen, const Lanes &a) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = only(where(chosen >> i * W & ((1u << W) - 1)), a.part[i]);
    return r;
}

// `yes` in the lanes whose bit is set, else `no`.
inline Lanes pick(unsigned chosen, const Lanes &yes, const Lanes &no) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i)
        r.part[i] = pick(where(chosen >> i * W & ((1u << W) - 1)), yes.part[i], no.part[i]);
    return r;
}

// Adds 1 to rank_b where a > b, else to rank_a; returns the lanes where a == b.
inline unsigned count_before(const Lanes &a, const Lanes &b, Lanes &rank_a, Lanes &rank_b) {
    unsigned ties = 0;
    for (int i = 0; i < PARTS; ++i) {
        const vm first = greater(a.part[i], b.part[i]);
        rank_b.part[i] = add_where(rank_b.part[i], first, set1(1));
        rank_a.part[i] = add_where(rank_a.part[i], not_mask(first), set1(1));
        ties |= bits(equal(a.part[i], b.part[i])) << i * W;
    }
    return ties;
}

inline float sum(const Lanes &a) {
    alignas(64) float v[LANES];
    store_lanes(v, a);
    f4 s = (load4(v) + load4(v + 8)) + (load4(v + 4) + load4(v + 12));
    return (s[0] + s[2]) + (s[1] + s[3]);
}

// Adds the sum of each of 16 `terms` to `totals`; each is summed as by sum().
inline void add_totals(const Lanes terms[16], float *totals) {
#if defined(__AVX512F__)
    // Halves the vectors and their lanes in each of four rounds.
    __m512 a[16];
    for (int i = 0; i < 16; ++i) a[i] = terms[i].part[0];
    for (int i = 0; i < 8; ++i)
        a[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a[2 * i], a[2 * i + 1], 0x44), _mm512_shuffle_f32x4(a[2 * i], a[2 * i + 1], 0xEE));
    for (int i = 0; i < 4; ++i)
        a[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a[2 * i], a[2 * i + 1], 0x88), _mm512_shuffle_f32x4(a[2 * i], a[2 * i + 1], 0xDD));
    for (int i = 0; i < 2; ++i)
        a[i] = _mm512_add_ps(_mm512_shuffle_ps(a[2 * i], a[2 * i + 1], 0x44), _mm512_shuffle_ps(a[2 * i], a[2 * i + 1], 0xEE));
    const __m512 s = _mm512_add_ps(_mm512_shuffle_ps(a[0], a[1], 0x88), _mm512_shuffle_ps(a[0], a[1], 0xDD));
    // Lane 4 b + c holds the sum of vector 4 c + b.
    const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    store(totals, load(totals) + _mm512_permutexvar_ps(order, s));
#else
    for (int i = 0; i < 16; ++i) totals[i] += sum(terms[i]);
#endif
}

}  // namespace ms
