// Moves the vertices of fans towards the nearest affine image of a regular polygon: a flat ellipse.
#pragma once

#include <cstdint>

#include "parallel.h"

extern "C" {

struct MsFans {
    int64_t count;
    int32_t sides, threads;
    float *vertices;        // (count, 1 + sides, 3): centre first, then the rim in order; in and out
    const double *polygon;  // (sides, 2) the regular polygon, cosines and sines
    double share;           // of the distance, 0 to 1
};

}  // extern "C"

namespace ms {

// The affine image with the least sum of squared distances: cosines and sines of a regular polygon are
// orthogonal to each other and to constants, so that each coefficient is a sum over the rim.
inline void round_fans(const MsFans &fans) {
    constexpr int64_t BLOCK = 4096;
    MS_ASSERT(fans.count >= 0 && fans.sides >= 3);
    parallel_blocks(fans.threads, fans.count, BLOCK, [&](int64_t begin, int64_t end, int) {
        const int sides = fans.sides;
        for (int64_t fan = begin; fan < end; ++fan) {
            float *center = fans.vertices + fan * (1 + sides) * 3, *rim = center + 3;
            double mean[3] = {}, cosine[3] = {}, sine[3] = {};
            for (int i = 0; i < sides; ++i)
                for (int axis = 0; axis < 3; ++axis) {
                    const double value = rim[i * 3 + axis];
                    mean[axis] += value;
                    cosine[axis] += fans.polygon[2 * i] * value;
                    sine[axis] += fans.polygon[2 * i + 1] * value;
                }
            for (int axis = 0; axis < 3; ++axis) {
                mean[axis] /= sides;
                cosine[axis] *= 2.0 / sides;
                sine[axis] *= 2.0 / sides;
                center[axis] += (float)(fans.share * (mean[axis] - center[axis]));
            }
            for (int i = 0; i < sides; ++i)
                for (int axis = 0; axis < 3; ++axis) {
                    float &value = rim[i * 3 + axis];
                    const double on_ellipse = mean[axis] + fans.polygon[2 * i] * cosine[axis] +
                                              fans.polygon[2 * i + 1] * sine[axis];
                    value += (float)(fans.share * (on_ellipse - value));
                }
        }
    });
}

}  // namespace ms
