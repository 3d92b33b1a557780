// Geometric consistency of the depth maps of several views, with each other and with points; and filling of
// the gaps between known depths.
#pragma once

#include "photos.h"

extern "C" {

struct MsConsistency {
    MsViews views;
    const float *inverse;      // (pixels) inverse depths that are checked; 0: none
    const float *others;       // (pixels) those that they are checked against; 0: unknown
    const int32_t *neighbors;  // (views.count, neighbor_count) views that check each; negative: none
    // Results, (pixels): neighbors that see the same place, that see past it, and that have it in the image
    // with nothing known in front of it.
    uint8_t *agree, *past, *seen;
    float tolerance, past_tolerance;  // relative to the depth
    int32_t neighbor_count;
};

struct MsFilling {
    MsViews views;
    const uint8_t *color;                      // (pixels, 3)
    const float *inverse, *along_x, *along_y;  // (pixels) planes
    const uint8_t *known;                      // (pixels) whose planes are continued to the others
    float *result;                             // (pixels) inverse depths; 0 where nothing is known
    float per_pixel;                           // cost of a step, in differences of colour
};

// How many views agree with points, and how many see past them.
struct MsCarving {
    MsViews views;
    const float *inverse;   // (pixels) known inverse depths; 0: none
    const double *points;   // (count, 3)
    int32_t *agree, *past;  // results, (count)
    int64_t count;
    float tolerance, past_tolerance;
};

}  // extern "C"

namespace ms {

// What is known in front of a place hides it where it is nearer by this much more than what sees past it.
constexpr float IN_FRONT = 0.02f;

inline void count_consistent(const MsConsistency &input) {
    const MsViews &views = input.views;
    parallel_blocks(views.threads, views.count, 1, [&](int64_t view, int64_t, int) {
        struct Neighbor {
            Warp warp;
            const float *inverse;
        };
        const MsCamera &camera = views.cameras[view];
        std::vector<Neighbor> neighbors;
        for (int k = 0; k < input.neighbor_count; ++k) {
            const int other = input.neighbors[view * input.neighbor_count + k];
            if (other < 0) continue;
            if (other >= views.count)
                throw std::invalid_argument("view " + std::to_string(other) + " of " +
                                            std::to_string(views.count));
            neighbors.push_back({Warp(camera, views.cameras[other], 0), input.others + views.start[other]});
        }
        for (int y = 0; y < camera.height; ++y)
            for (int x = 0; x < camera.width; ++x) {
                const int64_t i = views.start[view] + (int64_t)y * camera.width + x;
                const float q = input.inverse[i], u = (float)x + 0.5f, v = (float)y + 0.5f;
                int agree = 0, past = 0, seen = 0;
                if (q > 0)
                    for (const Neighbor &neighbor : neighbors) {
                        const Warp &warp = neighbor.warp;
                        const float z = warp.row(2, u, v, q);
                        if (!(z > 1e-6f)) continue;
                        const float column = warp.row(0, u, v, q) / z, row = warp.row(1, u, v, q) / z;
                        if (!(column >= 0 && row >= 0 && column < (float)warp.width &&
                              row < (float)warp.height))
                            continue;
                        const float known = neighbor.inverse[(int64_t)row * warp.width + (int)column];
                        const float ratio = z / q * known;  // depth there by the depth that is known there
                        seen += !(ratio > 1 + input.past_tolerance + IN_FRONT);
                        if (!(known > 0)) continue;
                        // What a pixel there is in depth: nearer matches cannot be expected.
                        const float du = (warp.shift[0] - column * warp.shift[2]) / z;
                        const float dv = (warp.shift[1] - row * warp.shift[2]) / z;
                        const float pixel = 1 / (std::max(std::sqrt(du * du + dv * dv), 1e-9f) * q);
                        const float slack = std::min(pixel, 4 * input.tolerance);
                        agree += std::fabs(ratio - 1) < std::max(input.tolerance, slack);
                        past += ratio < 1 - input.past_tolerance - slack;
                    }
                input.agree[i] = (uint8_t)std::min(agree, 255);
                input.past[i] = (uint8_t)std::min(past, 255);
                input.seen[i] = (uint8_t)std::min(seen, 255);
            }
    });
}

// Gives each pixel the plane of the known one to which the path is shortest, by its length and the
// differences of colour along it (a geodesic distance transform by raster scans: Toivanen 1996).
inline void fill_depths(const MsFilling &input) {
    constexpr int SCANS = 4;
    constexpr float FAR = 1e30f;
    const MsViews &views = input.views;
    parallel_blocks(views.threads, views.count, 1, [&](int64_t view, int64_t, int) {
        const int width = views.cameras[view].width, height = views.cameras[view].height;
        const int64_t start = views.start[view], size = (int64_t)width * height;
        const uint8_t *color = input.color + 3 * start;
        std::vector<float> distance(size);
        std::vector<int32_t> from(size);
        for (int64_t i = 0; i < size; ++i) {
            distance[i] = input.known[start + i] ? 0 : FAR;
            from[i] = input.known[start + i] ? (int32_t)i : -1;
        }
        for (int scan = 0; scan < SCANS; ++scan) {
            const bool forward = scan % 2 == 0;
            const int back = forward ? -1 : 1;
            const int beside[4][2] = {{back, 0}, {0, back}, {back, back}, {-back, back}};
            for (int row = 0; row < height; ++row)
                for (int column = 0; column < width; ++column) {
                    const int x = forward ? column : width - 1 - column, y = forward ? row : height - 1 - row;
                    const int64_t i = (int64_t)y * width + x;
                    for (const auto &[dx, dy] : beside) {
                        const int u = x + dx, v = y + dy;
                        if (u < 0 || v < 0 || u >= width || v >= height) continue;
                        const int64_t j = (int64_t)v * width + u;
                        int difference = 0;
                        for (int k = 0; k < 3; ++k)
                            difference = std::max(difference, std::abs(color[3 * i + k] - color[3 * j + k]));
                        const float length = dx && dy ? 1.4f : 1.0f;
                        const float found = distance[j] + length * (input.per_pixel + (float)difference);
                        if (found < distance[i]) distance[i] = found, from[i] = from[j];
                    }
                }
        }
        for (int64_t i = 0; i < size; ++i) {
            const int64_t j = start + from[i];
            if (from[i] < 0) {
                input.result[start + i] = 0;
                continue;
            }
            const float dx = (float)(i % width - from[i] % width), dy = (float)(i / width - from[i] / width);
            const float q = input.inverse[j] + input.along_x[j] * dx + input.along_y[j] * dy;
            input.result[start + i] = std::clamp(q, 0.7f * input.inverse[j], 1.4f * input.inverse[j]);
        }
    });
}

inline void count_views(const MsCarving &input) {
    const MsViews &views = input.views;
    parallel_blocks(views.threads, input.count, 4096, [&](int64_t begin, int64_t end, int) {
        std::fill(input.agree + begin, input.agree + end, 0);
        std::fill(input.past + begin, input.past + end, 0);
        for (int view = 0; view < views.count; ++view) {
            const MsCamera &camera = views.cameras[view];
            const double *m = camera.world_to_camera;
            for (int64_t i = begin; i < end; ++i) {
                const double *p = input.points + 3 * i;
                double at[3];
                for (int k = 0; k < 3; ++k)
                    at[k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
                if (!(at[2] > 0)) continue;
                const double column = camera.fx * at[0] / at[2] + camera.cx,
                             row = camera.fy * at[1] / at[2] + camera.cy;
                if (!(column >= 0 && row >= 0 && column < camera.width && row < camera.height)) continue;
                const float known =
                    input.inverse[views.start[view] + (int64_t)row * camera.width + (int)column];
                if (!(known > 0)) continue;
                const float ratio = (float)at[2] * known;
                input.agree[i] += std::fabs(ratio - 1) < input.tolerance;
                input.past[i] += ratio < 1 - input.past_tolerance;
            }
        }
    });
}

}  // namespace ms
