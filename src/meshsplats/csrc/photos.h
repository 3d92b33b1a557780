// Photographs for stereo: grey values in two sizes, and where pixels of one lie in another.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "check.h"
#include "parallel.h"
#include "simd.h"
#include "types.h"

extern "C" {

// Images of several cameras, one after the other; every array with a value per pixel goes by `start`.
struct MsViews {
    const MsCamera *cameras;  // (count)
    const int64_t *start;     // (count + 1) first pixel of each
    int32_t count, threads;
};

}  // extern "C"

namespace ms {

// A grey image for bilinear samples: one word for each pixel has its value and those to the right, below, and
// to the right below, a byte each. So a sample is one gather.
struct GreyImage {
    int width = 0, height = 0;
    std::vector<uint32_t> words;

    GreyImage() = default;
    GreyImage(const uint8_t *values, int width, int height)
        : width(width), height(height), words((size_t)width * height) {
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const int right = std::min(x + 1, width - 1), below = std::min(y + 1, height - 1);
                words[(size_t)y * width + x] = values[y * width + x] | values[y * width + right] << 8 |
                                               values[below * width + x] << 16 |
                                               (uint32_t)values[below * width + right] << 24;
            }
    }
    float at(int x, int y) const {
        x = std::clamp(x, 0, width - 1), y = std::clamp(y, 0, height - 1);
        return (float)(words[(size_t)y * width + x] & 255);
    }
};

// A photograph at its size for matching (level 0) and at half of it (level 1).
struct GreyPhoto {
    GreyImage level[2];

    GreyPhoto() = default;
    GreyPhoto(const uint8_t *color, int width, int height) {
        std::vector<uint8_t> grey((size_t)width * height);
        for (size_t i = 0; i < grey.size(); ++i)
            grey[i] = (uint8_t)((77 * color[3 * i] + 153 * color[3 * i + 1] + 26 * color[3 * i + 2]) >> 8);
        level[0] = GreyImage(grey.data(), width, height);
        const int half_width = (width + 1) / 2, half_height = (height + 1) / 2;
        std::vector<uint8_t> half((size_t)half_width * half_height);
        for (int y = 0; y < half_height; ++y)
            for (int x = 0; x < half_width; ++x) {
                const uint32_t word = level[0].words[(size_t)2 * y * width + 2 * x];
                half[(size_t)y * half_width + x] =
                    (uint8_t)(((word & 255) + (word >> 8 & 255) + (word >> 16 & 255) + (word >> 24) + 2) >>
                              2);
            }
        level[1] = GreyImage(half.data(), half_width, half_height);
    }
};

// Where the place that is seen at pixel (x, y), at inverse depth q, lies in another image: at (U / Z, V / Z)
// with (U, V, Z) = turn (x, y, 1) + q shift. Z / q is its depth there.
struct Warp {
    float turn[9], shift[3];
    int width, height;

    Warp(const MsCamera &from, const MsCamera &to, int level) {
        const double scale = level ? 0.5 : 1.0;
        const double *a = from.world_to_camera, *b = to.world_to_camera;
        double rotation[9], offset[3];
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j)
                rotation[3 * i + j] =
                    b[4 * i] * a[4 * j] + b[4 * i + 1] * a[4 * j + 1] + b[4 * i + 2] * a[4 * j + 2];
            offset[i] = b[4 * i + 3];
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) offset[i] -= rotation[3 * i + j] * a[4 * j + 3];
        const double focal[2] = {scale * to.fx, scale * to.fy}, middle[2] = {scale * to.cx, scale * to.cy};
        const double fx = scale * from.fx, fy = scale * from.fy, cx = scale * from.cx, cy = scale * from.cy;
        for (int i = 0; i < 3; ++i) {
            double row[4];
            for (int j = 0; j < 4; ++j) {
                auto entry = [&](int k) { return j < 3 ? rotation[3 * k + j] : offset[k]; };
                row[j] = i < 2 ? focal[i] * entry(i) + middle[i] * entry(2) : entry(2);
            }
            turn[3 * i] = (float)(row[0] / fx);
            turn[3 * i + 1] = (float)(row[1] / fy);
            turn[3 * i + 2] = (float)(row[2] - row[0] * cx / fx - row[1] * cy / fy);
            shift[i] = (float)row[3];
        }
        width = level ? (to.width + 1) / 2 : to.width;
        height = level ? (to.height + 1) / 2 : to.height;
    }

    template <class T>
    T row(int i, T x, float y, T q) const {
        return turn[3 * i] * x + (turn[3 * i + 1] * y + turn[3 * i + 2]) + q * shift[i];
    }
};

// Whether all four values of a bilinear sample at (u, v) are of the image.
inline vm in_image(const Warp &warp, vf u, vf v, vf z) {
    return mask_and(
        mask_and(greater(z, set1(1e-5f)), mask_and(greater_equal(u, set1(1)), greater_equal(v, set1(1)))),
        mask_and(greater_equal(set1((float)warp.width - 1), u),
                 greater_equal(set1((float)warp.height - 1), v)));
}

// The image at (u, v), by bilinear interpolation; at the border where that is outside, or not a number.
inline vf sample(const GreyImage &image, vf u, vf v) {
    u = vmin(vmax(u - 0.5f, set1(0)), set1((float)image.width - 1));
    v = vmin(vmax(v - 0.5f, set1(0)), set1((float)image.height - 1));
    const vi column = truncated(u), row = truncated(v);
    const vf right = u - as_floats(column), down = v - as_floats(row);
    const vi word = gather(image.words.data(), row * image.width + column);
    const vf a = as_floats(word & 255), b = as_floats(word >> 8 & 255), c = as_floats(word >> 16 & 255),
             d = as_floats(word >> 24 & 255);
    const vf top = a + right * (b - a), bottom = c + right * (d - c);
    return top + down * (bottom - top);
}

// The mean of the two highest correlations: the others may not see the place. What one source alone sees
// counts for less.
struct BestTwo {
    static constexpr float UNSEEN = -1, LONE = 0.12f;
    vf first = set1(UNSEEN), second = set1(UNSEEN);

    void add(vf correlation) {
        second = vmax(second, vmin(first, correlation));
        first = vmax(first, correlation);
    }
    vf score() const { return select(greater(second, set1(-0.99f)), 0.5f * (first + second), first - LONE); }
};

// Variance of grey values below which a window is as good as plain.
constexpr float PLAIN = 2;

}  // namespace ms
