// Points on surfaces to flat patches, as many as are allowed, small where the surface has texture and large
// where it is plain.
//
// The set of all points is cut in two again and again: always the part in which a patch of one colour leaves
// the largest error that a cut takes away.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <queue>
#include <vector>

#include "check.h"
#include "parallel.h"

extern "C" {

struct MsFusion {
    const float *points;    // (count, 3)
    const float *normals;   // (count, 3) unit vectors; 0: unknown
    const float *pixels;    // (count) size of a pixel of its photograph at the point
    const uint8_t *colors;  // (count, 3)
    const uint8_t *sure;    // (count) 1: two views confirm it
    // Result, (wanted, 21): position, the longer axis, the shorter one, the normal, standard deviations along
    // them, colour (0 to 1), size of a pixel, share of sure points, number of points.
    float *patches;
    int64_t count;
    int32_t wanted, threads;
    float largest;  // standard deviation of a patch, in pixels
    int32_t found;  // result: number of patches
};

}  // extern "C"

namespace ms {

class Fusion {
  public:
    explicit Fusion(const MsFusion &input) : input_(input), points_(input.count) {
        parallel_blocks(input.threads, input.count, 1 << 16, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i) {
                Point &p = points_[i];
                p.sure = input.sure[i];
                p.pixel = input.pixels[i];
                for (int k = 0; k < 3; ++k) {
                    p.at[k] = input.points[3 * i + k];
                    p.color[k] = input.colors[3 * i + k];
                    p.normal[k] = (int8_t)std::lrint(127 * std::clamp(input.normals[3 * i + k], -1.0f, 1.0f));
                }
            }
        });
    }

    int run() {
        if (points_.empty() || input_.wanted < 1) return 0;
        std::vector<Part> parts;
        parts.reserve(input_.wanted);
        auto later = [&](int a, int b) {
            return parts[a].gain != parts[b].gain ? parts[a].gain < parts[b].gain : a > b;
        };
        std::priority_queue<int, std::vector<int>, decltype(later)> queue(later);
        parts.push_back(measured(0, (int64_t)points_.size()));
        queue.push(0);
        while ((int)parts.size() < input_.wanted && !queue.empty()) {
            stop_point();
            const int chosen = queue.top();
            queue.pop();
            const Part part = parts[chosen];
            if (!(part.gain > 0)) break;
            const double *axis = part.axes[part.cut_axis];
            const double place = dot(axis, part.mean) + part.cut;
            Point *begin = points_.data() + part.begin, *end = points_.data() + part.end;
            Point *middle = std::partition(begin, end, [&](const Point &p) {
                return axis[0] * p.at[0] + axis[1] * p.at[1] + axis[2] * p.at[2] < place;
            });
            if (middle == begin || middle == end) continue;
            const int64_t cut = middle - points_.data();
            parts[chosen] = measured(part.begin, cut);
            parts.push_back(measured(cut, part.end));
            queue.push(chosen);
            queue.push((int)parts.size() - 1);
        }
        for (size_t i = 0; i < parts.size(); ++i) write(parts[i], input_.patches + FIELDS * i);
        return (int)parts.size();
    }

  private:
    static constexpr int FIELDS = 21;
    static constexpr int FEWEST = 8;       // points of a part that is cut
    static constexpr double FIRST = 1e20;  // added to the gain of parts that are cut before all others
    static constexpr int64_t MOST = 1500;  // points of a part that are looked at, about

    struct Point {
        float at[3], pixel;
        uint8_t color[3], sure;
        int8_t normal[3];
    };
    struct Part {
        int64_t begin, end;
        double mean[3], axes[3][3];  // the longer axis in the patch, the shorter one, its normal
        double deviation[3];         // along the axes
        double color[3], pixel, sure;
        double gain;  // of cutting it: the error that goes; 0: it is not to be cut
        int cut_axis;
        double cut;  // where, from the mean
    };

    static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

    static void cross(const double *a, const double *b, double *result) {
        for (int i = 0; i < 3; ++i)
            result[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
    }

    static void normalize(double *a) {
        const double length = std::max(std::sqrt(dot(a, a)), 1e-300);
        for (int i = 0; i < 3; ++i) a[i] /= length;
    }

    Part measured(int64_t begin, int64_t end) const {
        Part part{};
        part.begin = begin, part.end = end;
        const int64_t stride = end - begin > 2 * MOST ? (end - begin) / MOST : 1;
        double count = 0, pixels = 0, normal[3] = {};
        for (int64_t i = begin; i < end; i += stride) {
            const Point &p = points_[i];
            count += 1, pixels += std::log(p.pixel), part.sure += p.sure;
            for (int k = 0; k < 3; ++k)
                part.mean[k] += p.at[k], part.color[k] += p.color[k], normal[k] += p.normal[k];
        }
        for (int k = 0; k < 3; ++k) part.mean[k] /= count, part.color[k] /= count;
        part.pixel = std::exp(pixels / count), part.sure /= count;
        double covariance[3][3] = {}, error = 0;
        for (int64_t i = begin; i < end; i += stride) {
            const Point &p = points_[i];
            for (int k = 0; k < 3; ++k) {
                for (int l = 0; l <= k; ++l)
                    covariance[k][l] += (p.at[k] - part.mean[k]) * (p.at[l] - part.mean[l]);
                error += (p.color[k] - part.color[k]) * (p.color[k] - part.color[k]);
            }
        }
        for (int k = 0; k < 3; ++k)
            for (int l = 0; l <= k; ++l) covariance[l][k] = covariance[k][l] /= count;
        choose_axes(part, covariance, normal, count);
        choose_cut(part, count, stride, error);
        return part;
    }

    // Normals of the matched planes are better than that of the points, which scatter along the rays; where
    // they contradict each other, it is the direction in which the points scatter least.
    static void choose_axes(Part &part, const double covariance[3][3], const double *normals, double count) {
        double *first = part.axes[0], *second = part.axes[1], *normal = part.axes[2];
        std::copy_n(normals, 3, normal);
        const double length = std::sqrt(dot(normal, normal));
        if (length < 0.4 * 127 * count) {
            const double trace = covariance[0][0] + covariance[1][1] + covariance[2][2];
            const double start[3] = {0.3, 0.5, 0.8};
            if (!(length > 0)) std::copy_n(start, 3, normal);
            normalize(normal);
            for (int k = 0; k < 3; ++k) normal[k] += 0.01 * (k + 1);
            for (int i = 0; i < 30; ++i) {  // power iteration on trace - covariance
                double next[3];
                for (int k = 0; k < 3; ++k) next[k] = trace * normal[k] - dot(covariance[k], normal);
                if (!(dot(next, next) > 0)) break;
                normalize(next);
                std::copy_n(next, 3, normal);
            }
        }
        normalize(normal);
        int least = 0;
        for (int k = 1; k < 3; ++k)
            if (std::fabs(normal[k]) < std::fabs(normal[least])) least = k;
        double unit[3] = {}, x[3], y[3];
        unit[least] = 1;
        cross(normal, unit, x);
        normalize(x);
        cross(normal, x, y);
        auto product = [&](const double *a, const double *b) {
            return a[0] * dot(covariance[0], b) + a[1] * dot(covariance[1], b) + a[2] * dot(covariance[2], b);
        };
        // The axes of the ellipse in the plane; the first is the longer one.
        const double turn = 0.5 * std::atan2(2 * product(x, y), product(x, x) - product(y, y));
        for (int k = 0; k < 3; ++k) {
            first[k] = std::cos(turn) * x[k] + std::sin(turn) * y[k];
            second[k] = std::cos(turn) * y[k] - std::sin(turn) * x[k];
        }
        for (int k = 0; k < 3; ++k)
            part.deviation[k] = std::sqrt(std::max(product(part.axes[k], part.axes[k]), 0.0));
    }

    // The best of cuts across both axes in the patch, by the error that two mean colours take away. Parts
    // that are too large or thick come first.
    void choose_cut(Part &part, double count, int64_t stride, double error) const {
        constexpr int CUTS = 3;
        constexpr double APART = 0.7;  // of two cuts, in standard deviations
        double below[2][CUTS] = {}, sums[2][CUTS][3] = {};
        for (int64_t i = part.begin; i < part.end; i += stride) {
            const Point &p = points_[i];
            const double offset[3] = {p.at[0] - part.mean[0], p.at[1] - part.mean[1], p.at[2] - part.mean[2]};
            for (int a = 0; a < 2; ++a) {
                const double along = dot(part.axes[a], offset);
                for (int c = 0; c < CUTS; ++c)
                    if (along < (c - 1) * APART * part.deviation[a]) {
                        below[a][c] += 1;
                        for (int k = 0; k < 3; ++k) sums[a][c][k] += p.color[k] - part.color[k];
                    }
            }
        }
        double best = 0;
        for (int a = 0; a < 2; ++a)
            for (int c = 0; c < CUTS; ++c) {
                const double n = below[a][c], rest = count - n;
                if (n < 2 || rest < 2 || part.deviation[a] < 0.3 * part.pixel) continue;
                const double gain = dot(sums[a][c], sums[a][c]) * (1 / n + 1 / rest);
                if (gain > best)
                    best = gain, part.cut_axis = a, part.cut = (c - 1) * APART * part.deviation[a];
            }
        if (best < 0.05 * error) part.cut_axis = 0, part.cut = 0;
        const bool several = part.end - part.begin >= FEWEST;
        const bool can = several && part.deviation[0] > 0.35 * part.pixel;
        if (can) part.gain = (double)(part.end - part.begin) / count * (best + 0.1 * error) + 1e-12;
        const bool thick = part.deviation[2] > 3 * part.pixel && part.deviation[2] > 0.7 * part.deviation[0];
        if (several && thick)
            part.cut_axis = 2, part.cut = 0, part.gain += FIRST;
        else if (can && part.deviation[0] > input_.largest * part.pixel)
            part.cut_axis = 0, part.cut = 0, part.gain += FIRST;
    }

    static void write(const Part &part, float *out) {
        auto put = [&](const double *values, int count) { out = std::copy_n(values, count, out); };
        const double rest[3] = {part.pixel, part.sure, (double)(part.end - part.begin)};
        put(part.mean, 3);
        put(part.axes[0], 9);
        put(part.deviation, 3);
        for (double value : part.color) *out++ = (float)(value / 255);
        put(rest, 3);
    }

    const MsFusion &input_;
    std::vector<Point> points_;
};

}  // namespace ms
