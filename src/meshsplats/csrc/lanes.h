// One float for each of the 16 samples of a block, as one, two or four SIMD vectors. The operations and their
// order are the same at every vector width.
#pragma once

#include <cstdint>
#include <cstring>

#include "simd.h"

namespace ms {

constexpr int LANES = 16, PARTS = LANES / W;

// A set of lanes: bit i is lane i.
using LaneMask = uint32_t;
constexpr LaneMask ALL_LANES = (1u << LANES) - 1;

inline LaneMask lowest_lane(LaneMask lanes) { return lanes & -lanes; }

struct Lanes {
    vf part[PARTS];
};

inline Lanes broadcast(float a) {
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
MS_LANES(operator*, (x * y))
MS_LANES(operator/, x / y)
MS_LANES(min_lanes, vmin(x, y))
MS_LANES(max_lanes, vmax(x, y))
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

// Clamps a to [low, high]; NaN becomes low.
inline Lanes clamp(const Lanes &a, const Lanes &low, const Lanes &high) {
    return min_lanes(max_lanes(a, low), high);
}

// The lanes where a > b, a >= b, a == b.
inline LaneMask greater(const Lanes &a, const Lanes &b) {
    LaneMask r = 0;
    for (int i = 0; i < PARTS; ++i) r |= bits(greater(a.part[i], b.part[i])) << i * W;
    return r;
}
inline LaneMask greater_equal(const Lanes &a, const Lanes &b) {
    LaneMask r = 0;
    for (int i = 0; i < PARTS; ++i) r |= greater_equal_bits(a.part[i], b.part[i]) << i * W;
    return r;
}
inline LaneMask equal(const Lanes &a, const Lanes &b) {
    LaneMask r = 0;
    for (int i = 0; i < PARTS; ++i) r |= bits(equal(a.part[i], b.part[i])) << i * W;
    return r;
}

// The mask of vector i of a Lanes.
inline vm part_mask(LaneMask lanes, int i) { return mask_of(lanes >> i * W & ((1u << W) - 1)); }

// a in the chosen lanes, 0 elsewhere.
inline Lanes masked(LaneMask chosen, const Lanes &a) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = masked(part_mask(chosen, i), a.part[i]);
    return r;
}

// `yes` in the chosen lanes, `no` elsewhere.
inline Lanes select(LaneMask chosen, const Lanes &yes, const Lanes &no) {
    Lanes r;
    for (int i = 0; i < PARTS; ++i) r.part[i] = select(part_mask(chosen, i), yes.part[i], no.part[i]);
    return r;
}

// One comparison of a rank sort, largest key first: adds 1 to rank_b where a > b, else to rank_a. Returns the
// lanes where a == b.
inline LaneMask update_ranks(const Lanes &a, const Lanes &b, Lanes &rank_a, Lanes &rank_b) {
    LaneMask ties = 0;
    for (int i = 0; i < PARTS; ++i) {
        const vm first = greater(a.part[i], b.part[i]);
        rank_b.part[i] = add_where(rank_b.part[i], first, set1(1));
        rank_a.part[i] = add_where(rank_a.part[i], mask_not(first), set1(1));
        ties |= bits(equal(a.part[i], b.part[i])) << i * W;
    }
    return ties;
}

// Where `value` exceeds `best`, replaces `best` by it and `best_index` by `index`.
inline void keep_greater(const Lanes &value, const Lanes &index, Lanes &best, Lanes &best_index) {
    for (int i = 0; i < PARTS; ++i) {
        const vm m = greater(value.part[i], best.part[i]);
        best.part[i] = select(m, value.part[i], best.part[i]);
        best_index.part[i] = select(m, index.part[i], best_index.part[i]);
    }
}

inline float sum(const Lanes &a) {
    alignas(64) float v[LANES];
    store_lanes(v, a);
    f4 s = (load4(v) + load4(v + 8)) + (load4(v + 4) + load4(v + 12));
    return (s[0] + s[2]) + (s[1] + s[3]);
}

// Lane 4 i + column of the result is the sum of terms[i] over the four rows of the block.
inline Lanes sum_rows(const Lanes terms[4]) {
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

// Lane 4 i + j of the result is the sum of row i, lanes 4 i to 4 i + 3, of terms[j].
inline Lanes sum_columns(const Lanes terms[4]) {
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
// Transposes the four 4 x 4 matrices whose row j lies in a[j].
inline void transpose_4x4(__m512 a[4]) {
    const __m512 low01 = _mm512_unpacklo_ps(a[0], a[1]), high01 = _mm512_unpackhi_ps(a[0], a[1]);
    const __m512 low23 = _mm512_unpacklo_ps(a[2], a[3]), high23 = _mm512_unpackhi_ps(a[2], a[3]);
    a[0] = _mm512_shuffle_ps(low01, low23, 0x44);
    a[1] = _mm512_shuffle_ps(low01, low23, 0xEE);
    a[2] = _mm512_shuffle_ps(high01, high23, 0x44);
    a[3] = _mm512_shuffle_ps(high01, high23, 0xEE);
}
#endif

// Transposes 16 rows of 4 floats: lane i of out[j] is row(i)[j].
template <class Row>
inline void load_transposed(Row &&row, Lanes out[4]) {
#if defined(__AVX512F__)
    __m512 a[4];
    for (int j = 0; j < 4; ++j) {
        a[j] = _mm512_castps128_ps512(load4(row(j)));
        a[j] = _mm512_insertf32x4(a[j], load4(row(4 + j)), 1);
        a[j] = _mm512_insertf32x4(a[j], load4(row(8 + j)), 2);
        a[j] = _mm512_insertf32x4(a[j], load4(row(12 + j)), 3);
    }
    transpose_4x4(a);
    for (int j = 0; j < 4; ++j) out[j].part[0] = a[j];
#else
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < 4; ++j) ((float *)&out[j])[i] = row(i)[j];
#endif
}

// The inverse: row(i) = {a[i], b[i], c[i], d[i]} for 16 rows.
template <class Row>
inline void store_transposed(const Lanes &a, const Lanes &b, const Lanes &c, const Lanes &d, Row &&row) {
    const Lanes columns[4] = {a, b, c, d};
#if defined(__AVX512F__)
    __m512 rows[4] = {columns[0].part[0], columns[1].part[0], columns[2].part[0], columns[3].part[0]};
    transpose_4x4(rows);
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
