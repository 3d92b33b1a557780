// A step of Adam (Kingma & Ba 2015) on some rows of an array: rows left out keep their values and moments.
// The operations and their order are those of torch.optim.SparseAdam.
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
    float *values, *mean, *square;  // (rows, columns): what is optimised and its first and second moment
    const float *gradient;          // (rows, columns)
    const float *scale;             // (rows,), times the step; or null
    const int32_t *chosen;          // row numbers, increasing; or null
    int64_t chosen_count;
    const uint8_t *mask;  // (rows,), 0: left out; or null. Without both every row is taken
    float step, beta1_rest, beta2_rest, epsilon;  // step: rate and bias corrections; the others: 1 - beta
    float low, high;                              // values end within these
};

}  // extern "C"

namespace ms {

// Rows [begin, end), which lie one after another.
inline void adam_run(const MsAdam &a, int64_t begin, int64_t end) {
    constexpr int BLOCK = 256;  // values
    float steps[BLOCK];
    const int64_t per_block = a.columns >= BLOCK ? 1 : BLOCK / a.columns;
    std::fill_n(steps, BLOCK, a.step);
    for (int64_t row = begin; row < end; row += per_block) {
        const int64_t rows = std::min(per_block, end - row);
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
                mean[i] += (g - mean[i]) * a.beta1_rest;
                square[i] += (g * g - square[i]) * a.beta2_rest;
                const float value = values[i] - steps[i] * (mean[i] / (std::sqrt(square[i]) + a.epsilon));
                values[i] = value < a.low ? a.low : value > a.high ? a.high : value;
            }
        }
    }
}

// The first place from `at` on where the mask is not 0, or `end`.
inline int64_t skip_zeros(const uint8_t *mask, int64_t at, int64_t end) {
    uint64_t eight;
    while (at + 8 <= end && (std::memcpy(&eight, mask + at, 8), eight == 0)) at += 8;
    while (at < end && !mask[at]) ++at;
    return at;
}

// Calls adam_run for each unbroken run of rows. Throws before any value changes if row numbers are not
// increasing numbers of rows.
inline void adam_rows(const MsAdam &a) {
    constexpr int64_t SHARE = 8192;  // rows
    if (a.chosen) {
        for (int64_t i = 0; i < a.chosen_count; ++i)
            if (a.chosen[i] < 0 || a.chosen[i] >= a.rows || (i && a.chosen[i] <= a.chosen[i - 1]))
                throw std::invalid_argument("row numbers must increase and lie in [0, " +
                                            std::to_string(a.rows) + "), got " + std::to_string(a.chosen[i]) +
                                            " at place " + std::to_string(i));
        parallel_blocks(a.threads, a.chosen_count, SHARE, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin, next; i < end; i = next) {
                for (next = i + 1; next < end && a.chosen[next] == a.chosen[next - 1] + 1;) ++next;
                adam_run(a, a.chosen[i], a.chosen[next - 1] + 1);
            }
        });
    } else if (a.mask) {
        parallel_blocks(a.threads, a.rows, SHARE, [&](int64_t begin, int64_t end, int) {
            for (int64_t row = begin, next; row < end; row = next) {
                if (!a.mask[row]) {
                    next = skip_zeros(a.mask, row, end);
                    continue;
                }
                for (next = row + 1; next < end && a.mask[next];) ++next;
                adam_run(a, row, next);
            }
        });
    } else {
        parallel_blocks(a.threads, a.rows, SHARE,
                        [&](int64_t begin, int64_t end, int) { adam_run(a, begin, end); });
    }
}

}  // namespace ms
