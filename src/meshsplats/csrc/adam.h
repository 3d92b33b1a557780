// Adam (Kingma & Ba 2015) on selected rows of an array. The operations and their order are those of
// torch.optim.SparseAdam: rows that are not selected keep their values and moments.
#pragma once

#include <cmath>
#include <cstring>
#include <stdexcept>
#include <string>

#include "parallel.h"

extern "C" {

struct MsAdam {
    int64_t rows;
    int32_t columns, threads;
    float *values, *mean, *square;  // (rows, columns): parameters, first and second moments; in and out
    const float *gradient;          // (rows, columns)
    const float *scale;             // (rows,) factors of the step size, or null
    const int32_t *chosen;          // (chosen_count,) increasing row indices, or null
    int64_t chosen_count;
    const uint8_t *mask;  // (rows,) nonzero for selected rows, or null. Without both all rows are selected.
    float step;           // learning rate with bias corrections
    float one_minus_beta1, one_minus_beta2, epsilon;
    float low, high;  // values are clamped to this range
};

}  // extern "C"

namespace ms {

// One step for the rows [begin, end).
inline void adam_range(const MsAdam &a, int64_t begin, int64_t end) {
    MS_ASSERT(begin >= 0 && begin <= end && end <= a.rows && a.columns >= 1);
    constexpr int BLOCK = 256;  // values: whole rows, or a part of a long one
    float steps[BLOCK];
    const int64_t rows_per_block = a.columns >= BLOCK ? 1 : BLOCK / a.columns;
    std::fill_n(steps, BLOCK, a.step);
    for (int64_t row = begin; row < end; row += rows_per_block) {
        const int64_t rows = std::min(rows_per_block, end - row);
        for (int64_t first = row * a.columns, last = (row + rows) * a.columns; first < last; first += BLOCK) {
            const int n = (int)std::min<int64_t>(BLOCK, last - first);
            if (a.scale)
                for (int i = 0, c = 0, r = 0; i < n; ++i) {
                    steps[i] = a.step * a.scale[row + r];
                    if (++c == a.columns) c = 0, ++r;
                }
            float *__restrict values = a.values + first, *__restrict mean = a.mean + first;
            float *__restrict square = a.square + first;
            const float *__restrict gradient = a.gradient + first;
            for (int i = 0; i < n; ++i) {
                const float g = gradient[i];
                mean[i] += (g - mean[i]) * a.one_minus_beta1;
                square[i] += (g * g - square[i]) * a.one_minus_beta2;
                const float value = values[i] - steps[i] * (mean[i] / (std::sqrt(square[i]) + a.epsilon));
                values[i] = value < a.low ? a.low : value > a.high ? a.high : value;
            }
        }
    }
}

// The first index from `i` on where the mask is not 0, or `end`.
inline int64_t skip_zeros(const uint8_t *mask, int64_t i, int64_t end) {
    uint64_t eight;
    while (i + 8 <= end && (std::memcpy(&eight, mask + i, 8), eight == 0)) i += 8;
    while (i < end && !mask[i]) ++i;
    return i;
}

// One step for all selected rows. Throws before any value changes if the row indices are out of range or do
// not increase.
inline void adam_rows(const MsAdam &a) {
    constexpr int64_t BLOCK = 8192;  // rows or row indices
    if (a.chosen) {
        for (int64_t i = 0; i < a.chosen_count; ++i)
            if (a.chosen[i] < 0 || a.chosen[i] >= a.rows || (i && a.chosen[i] <= a.chosen[i - 1]))
                throw std::invalid_argument("row indices must increase and lie in [0, " +
                                            std::to_string(a.rows) + "), got " + std::to_string(a.chosen[i]) +
                                            " at index " + std::to_string(i));
        parallel_blocks(a.threads, a.chosen_count, BLOCK, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin, next; i < end; i = next) {
                for (next = i + 1; next < end && a.chosen[next] == a.chosen[next - 1] + 1;) ++next;
                adam_range(a, a.chosen[i], a.chosen[next - 1] + 1);
            }
        });
    } else if (a.mask) {
        parallel_blocks(a.threads, a.rows, BLOCK, [&](int64_t begin, int64_t end, int) {
            for (int64_t row = begin, next; row < end; row = next) {
                if (!a.mask[row]) {
                    next = skip_zeros(a.mask, row, end);
                    continue;
                }
                for (next = row + 1; next < end && a.mask[next];) ++next;
                adam_range(a, row, next);
            }
        });
    } else {
        parallel_blocks(a.threads, a.rows, BLOCK,
                        [&](int64_t begin, int64_t end, int) { adam_range(a, begin, end); });
    }
}

}  // namespace ms
