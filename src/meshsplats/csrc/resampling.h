// Images looked up between their pixels, as where a lens saw the rays of a pinhole.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>

#include "parallel.h"

extern "C" {

struct MsResampling {
    const float *points;   // (count, 2) column and row, whole at the centres of pixels; not a number: none
    const uint8_t *bytes;  // (height, width, channels) the image, either this or the next one
    const float *values;
    void *result;  // (count, channels), of the image's type; stays where there is no point
    int64_t count;
    int32_t height, width, channels;
    int32_t wraps;  // whether the first column follows the last one
    int32_t threads;
};

}  // extern "C"

namespace ms {

// Bilinear; points beyond the border take the values there.
template <class T>
void resample(const MsResampling &input, const T *image) {
    const int width = input.width, height = input.height, channels = input.channels;
    MS_ASSERT(width >= 1 && height >= 1 && channels >= 1);
    T *result = static_cast<T *>(input.result);
    parallel_blocks(input.threads, input.count, 1 << 14, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            float x = input.points[2 * i], y = input.points[2 * i + 1];
            if (std::isnan(x) || std::isnan(y)) continue;
            x = std::clamp(x, 0.0f, input.wraps ? (float)width : (float)width - 1);
            y = std::clamp(y, 0.0f, (float)height - 1);
            int left = (int)x;
            const int top = (int)y, below = std::min(top + 1, height - 1);
            const float a = x - (float)left, b = y - (float)top;
            if (left == width) left = 0;
            const int right = left + 1 < width ? left + 1 : (input.wraps ? 0 : left);
            const float weights[4] = {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b};
            const T *corners[4] = {image + ((int64_t)top * width + left) * channels,
                                   image + ((int64_t)top * width + right) * channels,
                                   image + ((int64_t)below * width + left) * channels,
                                   image + ((int64_t)below * width + right) * channels};
            for (int k = 0; k < channels; ++k) {
                float mixed = 0;
                for (int corner = 0; corner < 4; ++corner)
                    mixed += weights[corner] * (float)corners[corner][k];
                if constexpr (std::is_integral_v<T>) mixed = std::nearbyint(mixed);
                result[i * channels + k] = (T)mixed;
            }
        }
    });
}

inline void resample(const MsResampling &input) {
    if (input.bytes)
        resample(input, input.bytes);
    else
        resample(input, input.values);
}

}  // namespace ms
