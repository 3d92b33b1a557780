// Neighbours by the cells of a grid: the vertices of a surface that are nearest to places, and sums over the
// points of the cells around each point.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "parallel.h"

extern "C" {

struct MsNearestVertices {
    const double *places, *normals;  // (count, 3)
    const int32_t *ids;              // (size) the vertex of each cell, negative where there is none
    const float *vertices;           // (..., 3) of the surface
    const double *vertex_normals;
    int64_t *index;  // (count) the nearest vertex
    uint8_t *found;  // (count) whether there is one
    int64_t count, size[3];
    double low[3], side;  // of the cells
    double facing_away;   // weight of a squared distance to a vertex whose normal faces the other way
    int32_t reach;        // in cells, along each axis
    int32_t threads;
};

struct MsCellSums {
    const double *points;   // (count, 3)
    const int32_t *cell;    // (count) of each point
    const int32_t *beside;  // (cells, around) the cells around each cell and itself, negative where none is
    const double *middle;   // (cells, 3) means of their points
    const double *values;   // (cells, channels) sums over their points
    double *total;          // (count, channels)
    int64_t count;
    int32_t around, channels;
    double falloff;  // weight exp(-falloff d^2) of a cell whose middle is d away
    int32_t threads;
};

}  // extern "C"

namespace ms {

inline void nearest_vertices(const MsNearestVertices &in) {
    parallel_blocks(in.threads, in.count, 1 << 10, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            const double *place = in.places + 3 * i, *normal = in.normals + 3 * i;
            int64_t first[3], last[3];
            bool near = true;
            for (int k = 0; k < 3; ++k) {
                // Far strays must not overflow.
                const double step = std::clamp(std::floor((place[k] - in.low[k]) / in.side), -1.0 - in.reach,
                                               (double)in.size[k] + in.reach);
                first[k] = std::max<int64_t>((int64_t)step - in.reach, 0);
                last[k] = std::min<int64_t>((int64_t)step + in.reach, in.size[k] - 1);
                near &= first[k] <= last[k];
            }
            double best = std::numeric_limits<double>::infinity();
            int64_t index = 0;
            for (int64_t x = first[0]; near && x <= last[0]; ++x)
                for (int64_t y = first[1]; y <= last[1]; ++y)
                    for (int64_t z = first[2]; z <= last[2]; ++z) {
                        const int64_t vertex = in.ids[(x * in.size[1] + y) * in.size[2] + z];
                        if (vertex < 0) continue;
                        double away = 0, facing = 0;
                        for (int k = 0; k < 3; ++k) {
                            const double step = place[k] - in.vertices[3 * vertex + k];
                            away += step * step;
                            facing += normal[k] * in.vertex_normals[3 * vertex + k];
                        }
                        if (facing < 0) away *= in.facing_away;
                        if (away < best) best = away, index = vertex;
                    }
            in.index[i] = index;
            in.found[i] = best < std::numeric_limits<double>::infinity();
        }
    });
}

inline void sum_cells(const MsCellSums &in) {
    parallel_blocks(in.threads, in.count, 1 << 10, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            const double *point = in.points + 3 * i;
            double *total = in.total + i * in.channels;
            std::fill(total, total + in.channels, 0.0);
            const int32_t *beside = in.beside + (int64_t)in.cell[i] * in.around;
            for (int32_t j = 0; j < in.around; ++j) {
                if (beside[j] < 0) continue;
                double square = 0;
                for (int k = 0; k < 3; ++k) {
                    const double step = in.middle[3 * (int64_t)beside[j] + k] - point[k];
                    square += step * step;
                }
                const double share = std::exp(-in.falloff * square);
                const double *values = in.values + (int64_t)beside[j] * in.channels;
                for (int32_t k = 0; k < in.channels; ++k) total[k] += share * values[k];
            }
        }
    });
}

}  // namespace ms
