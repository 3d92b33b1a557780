// The 16 samples of a block, one number each. Operations are those of the vectors they consist of, in the
// same order at every vector width.
#pragma once

#include <cstring>

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
inline float lane_of(const Lanes &a, int lane) {
    float v;
    std::memcpy(&v, (const char *)&a + lane * sizeof v, sizeof v);
    return v;
}
inline void store_lanes(float *p, const Lanes &a) {
    for (int i = 0; i < PARTS; ++i) store(p + i * W, a.part[i]);
}

#define MS_LANES(name, expression)                      \
    inline Lanes name(const Lanes &a, const Lanes &b) { \
        Lanes r;                                        \
        for (int i = 0; i < PARTS; ++i) {               \
            const vf x = a.part[i], y = b.part[i];      \
            r.part[i] = expression;                     \
        }                                               \
        return r;                                       \
    }
MS_LANES(operator+, x + y)
MS_LANES(operator-, x - y)
MS_LANES(operator*, x *y)
MS_LANES(operator/, x / y)
MS_LANES(least, vmin(x, y))
MS_LANES(most, vmax(x, y))
#undef MS_LANES

inline Lanes mul_add(const Lanes &a, const Lanes &b, const Lanes &c) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = mul_add(a.part[i], b.part[i], c.part[i]);
    return r;
}

inline Lanes reciprocal(const Lanes &a) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = reciprocal(a.part[i]);
    return r;
}

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

// Where a is greater than `most`, puts a there and b into `which`.
inline void pick_greater(const Lanes &a, const Lanes &b, Lanes &most, Lanes &which) {
    for (int i = 0; i < PARTS; ++i) {
        const vm m = greater(a.part[i], most.part[i]);
        most.part[i] = pick(m, a.part[i], most.part[i]);
        which.part[i] = pick(m, b.part[i], which.part[i]);
    }
}

inline float sum(const Lanes &a) {
    alignas(64) float v[LANES];
    store_lanes(v, a);
    f4 s = (load4(v) + load4(v + 8)) + (load4(v + 4) + load4(v + 12));
    return (s[0] + s[2]) + (s[1] + s[3]);
}

// Lane 4 i + column: the sum over rows, four lanes each, of terms[i].
inline Lanes add_rows(const Lanes terms[4]) {
    Lanes r;
#if defined(__AVX512F__)
    __m512 half[2];
    for (int i = 0; i < 2; ++i) {
        const __m512 a = terms[2 * i].part[0], b = terms[2 * i + 1].part[0];
        half[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
    }
    r.part[0] = _mm512_add_ps(_mm512_shuffle_f32x4(half[0], half[1], 0x88),
                              _mm512_shuffle_f32x4(half[0], half[1], 0xDD));
#else
    f4 sums[4];
    for (int i = 0; i < 4; ++i) {
        f4 row[4];
        std::memcpy(row, &terms[i], sizeof row);
        sums[i] = (row[0] + row[2]) + (row[1] + row[3]);
    }
    std::memcpy(&r, sums, sizeof r);
#endif
    return r;
}

// Lane 4 i + j: the sum of lanes 4 i to 4 i + 3 of terms[j].
inline Lanes add_columns(const Lanes terms[4]) {
    Lanes r;
#if defined(__AVX512F__)
    __m512 half[2];
    for (int i = 0; i < 2; ++i) {
        const __m512 a = terms[2 * i].part[0], b = terms[2 * i + 1].part[0];
        half[i] = _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x44), _mm512_shuffle_ps(a, b, 0xEE));
    }
    r.part[0] =
        _mm512_add_ps(_mm512_shuffle_ps(half[0], half[1], 0x88), _mm512_shuffle_ps(half[0], half[1], 0xDD));
#else
    float sums[LANES], v[LANES];
    for (int j = 0; j < 4; ++j) {
        store_lanes(v, terms[j]);
        for (int i = 0; i < 4; ++i)
            sums[4 * i + j] = (v[4 * i] + v[4 * i + 2]) + (v[4 * i + 1] + v[4 * i + 3]);
    }
    r = load_lanes(sums);
#endif
    return r;
}

#if defined(__AVX512F__)
// Turns each group of four lanes, a square of four rows and four columns, over.
inline void turn(__m512 a[4]) {
    const __m512 low01 = _mm512_unpacklo_ps(a[0], a[1]), high01 = _mm512_unpackhi_ps(a[0], a[1]);
    const __m512 low23 = _mm512_unpacklo_ps(a[2], a[3]), high23 = _mm512_unpackhi_ps(a[2], a[3]);
    a[0] = _mm512_shuffle_ps(low01, low23, 0x44);
    a[1] = _mm512_shuffle_ps(low01, low23, 0xEE);
    a[2] = _mm512_shuffle_ps(high01, high23, 0x44);
    a[3] = _mm512_shuffle_ps(high01, high23, 0xEE);
}
#endif

// From rows of four numbers to columns of 16: lane i of out[j] is row(i)[j].
template <class Row>
inline void get_columns(Row &&row, Lanes out[4]) {
#if defined(__AVX512F__)
    __m512 a[4];
    for (int j = 0; j < 4; ++j) {
        a[j] = _mm512_castps128_ps512(load4(row(j)));
        a[j] = _mm512_insertf32x4(a[j], load4(row(4 + j)), 1);
        a[j] = _mm512_insertf32x4(a[j], load4(row(8 + j)), 2);
        a[j] = _mm512_insertf32x4(a[j], load4(row(12 + j)), 3);
    }
    turn(a);
    for (int j = 0; j < 4; ++j) out[j].part[0] = a[j];
#else
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < 4; ++j) ((float *)&out[j])[i] = row(i)[j];
#endif
}

// The way back: to rows of four numbers, 16 of them.
template <class Row>
inline void put_columns(const Lanes &a, const Lanes &b, const Lanes &c, const Lanes &d, Row &&row) {
    const Lanes columns[4] = {a, b, c, d};
#if defined(__AVX512F__)
    __m512 rows[4] = {columns[0].part[0], columns[1].part[0], columns[2].part[0], columns[3].part[0]};
    turn(rows);
    for (int j = 0; j < 4; ++j) {
        store4(row(j), _mm512_extractf32x4_ps(rows[j], 0));
        store4(row(4 + j), _mm512_extractf32x4_ps(rows[j], 1));
        store4(row(8 + j), _mm512_extractf32x4_ps(rows[j], 2));
        store4(row(12 + j), _mm512_extractf32x4_ps(rows[j], 3));
    }
#else
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < 4; ++j) row(i)[j] = ((const float *)&columns[j])[i];
#endif
}

}  // namespace ms
