// Truncated signed distances on a grid of points, fused from depth images (Curless and Levoy 1996).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "parallel.h"
#include "types.h"

extern "C" {

struct MsFusing {
    MsCamera camera;
    int64_t size[3];      // points of the grid along x, y and z
    double low[3];        // the first of them
    double voxel;         // distance of neighbours
    double center[3];     // of the ball beyond which the grid is contracted...
    double radius;        // ...and its radius; 0: nowhere
    double truncation;    // of distances, in scene units within the ball
    double behind;        // weight of distances behind the surface
    const float *depth;   // (height, width) camera depth, infinite where there is nothing
    float *sum, *weight;  // (x, y, z) of distances in units of the truncation, and of their weights; added to
    int32_t threads;
};

}  // extern "C"

namespace ms {

// Distances r from the centre that are longer than the radius are contracted to radius * (2 - radius / r) on
// the grid (Barron and others 2022).
template <bool Contracted>
inline void fuse_on(const MsFusing &in) {
    const double *m = in.camera.world_to_camera;
    parallel_blocks(in.threads, in.size[0], 1, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            const double even_x = in.low[0] + in.voxel * i;
            for (int64_t j = 0; j < in.size[1]; ++j) {
                const double even_y = in.low[1] + in.voxel * j;
                for (int64_t k = 0; k < in.size[2]; ++k) {
                    double x = even_x, y = even_y, z = in.low[2] + in.voxel * k, truncation = in.truncation;
                    if constexpr (Contracted) {
                        x -= in.center[0], y -= in.center[1], z -= in.center[2];
                        const double ratio = std::sqrt(x * x + y * y + z * z) / in.radius;
                        if (ratio >= 2) continue;  // beyond everything
                        if (ratio > 1) {
                            const double away = 1 / (2 - ratio), stretch = away / ratio;
                            x *= stretch, y *= stretch, z *= stretch, truncation *= away * away;
                        }
                        x += in.center[0], y += in.center[1], z += in.center[2];
                    }
                    const double away = (m[8] * x + m[11]) + m[9] * y + m[10] * z;
                    if (!(away > in.camera.near)) continue;
                    const double right = (m[0] * x + m[3]) + m[1] * y + m[2] * z,
                                 down = (m[4] * x + m[7]) + m[5] * y + m[6] * z,
                                 column = std::floor(in.camera.fx * right / away + in.camera.cx),
                                 row = std::floor(in.camera.fy * down / away + in.camera.cy);
                    if (!(column >= 0 && column < in.camera.width && row >= 0 && row < in.camera.height))
                        continue;
                    const float depth = in.depth[(int64_t)row * in.camera.width + (int64_t)column];
                    const double distance = (depth - away) / truncation;
                    if (!(distance >= -1)) continue;
                    const double share = distance < 0 ? in.behind : 1;
                    const int64_t at = (i * in.size[1] + j) * in.size[2] + k;
                    in.sum[at] = (float)(in.sum[at] + share * std::min(distance, 1.0));
                    in.weight[at] = (float)(in.weight[at] + share);
                }
            }
        }
    });
}

inline void fuse_depth(const MsFusing &in) {
    if (in.radius > 0)
        fuse_on<true>(in);
    else
        fuse_on<false>(in);
}

}  // namespace ms
