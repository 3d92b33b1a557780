// Moments of fans: mean and covariance of their opacity over the image, several fans at once.
//
// For a triangle of area T with opacities a_i at positions q_i, a = sum a_i, Q = sum q_i and B = sum a_i q_i,
// the integrals of opacity times 1, q and q q^T over the triangle are
//     T a / 3,  T / 12 (a Q + B),  T / 60 (a Q Q^T + B Q^T + Q B^T + sum (a + 2 a_i) q_i q_i^T).
//
// A fan seen edge on has no area in the image to weigh its triangles by: areas are those of triangles
// (x, y, k / z), where k scales depth to a share of the extent parallel to the image.
#pragma once

#include <algorithm>
#include <cmath>

#include "fan_vertices.h"
#include "triangle.h"

namespace ms {

// A projected vertex: position in samples, 1 / depth, opacity with its bias.
struct FanVertex {
    double x, y, w, a;
};

// The projected vertices of consecutive fans, those from the slot `base` on.
struct FanBlock {
    const MsMesh &mesh;
    const FanVertices &fans;
    const FanVertex *vertices;
    int32_t base;

    // Of the vertex at a corner of the faces.
    int32_t index(int64_t corner) const { return fans.slot(mesh.faces[corner]) - base; }
};

// Fans that are processed together, one in each lane. No lane depends on its neighbours.
struct FanBatch {
    int size;  // lanes in use; the others repeat the last fan
    int32_t fan[WD];
    int32_t first[WD];     // first triangles
    int32_t count[WD];     // numbers of triangles
    int32_t fewest, most;  // of the counts
    // The moments.
    vd k;                   // scale of depths: that of the fan's first vertex
    vd nearest;             // least 1 / depth of the corners
    vd mass, inverse_mass;  // 60 times the integral of opacity over doubled areas, and 1 / mass
    vd x, y;                // mean c
    vd m[3];                // covariance M: xx, xy, yy
    // The filter.
    vd inverse[3];    // of M with FanFilter::MIN_VARIANCE added
    vd a[3];          // A: xx, xy, yy
    bool active[WD];  // false: the fan stays as it is
};

// The vertices with the indices i, by field.
inline void gather(const FanBlock &block, const int32_t *i, vd fields[4]) {
    const double *rows[WD];
    for (int lane = 0; lane < WD; ++lane) rows[lane] = &block.vertices[i[lane]].x;
    transpose(rows, fields);
}
inline vd root(const vd &a) {
    vd roots;
    for (int lane = 0; lane < WD; ++lane) roots[lane] = std::sqrt(a[lane]);
    return roots;
}
inline void cross(const vd a[3], const vd b[3], vd out[3]) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

// Triangle `index` of each fan of a batch.
struct FanTriangles {
    int32_t slot[3][WD] = {};   // corners, less the block's base
    vd x[3], y[3], w[3], a[3];  // corners: position relative to an origin, 1 / depth, opacity
    vd alpha_sum;               // over the corners
    vd u[3], v[3], n[3];        // edges 0 to 1 and 0 to 2 in (x, y, k / z), and their cross product
    vd area;                    // doubled: |n|; 0 in the lanes of fans that have no such triangle

    // Loads triangle `index` of each fan, relative to the origins (x0, y0), over those before: most share the
    // fan's centre with them and begin at the corner where they end. Other corners are loaded.
    void load(const FanBlock &block, const FanBatch &batch, int index, const vd &x0, const vd &y0) {
        bool same_center = index > 0, joined = index > 0;
        for (int lane = 0; lane < WD; ++lane) {
            const int64_t face = batch.first[lane] + std::min(index, batch.count[lane] - 1);
            int32_t corner[3];
            for (int j = 0; j < 3; ++j) corner[j] = block.index(3 * face + j);
            same_center &= corner[0] == slot[0][lane];
            joined &= corner[1] == slot[2][lane];
            for (int j = 0; j < 3; ++j) slot[j][lane] = corner[j];
        }
        if (!same_center) load_corners(block, x0, y0, 0);
        if (joined) {
            x[1] = x[2], y[1] = y[2], w[1] = w[2], a[1] = a[2];
        } else {
            load_corners(block, x0, y0, 1);
        }
        load_corners(block, x0, y0, 2);
        alpha_sum = a[0] + a[1] + a[2];
        u[0] = x[1] - x[0], u[1] = y[1] - y[0], u[2] = batch.k * (w[1] - w[0]);
        v[0] = x[2] - x[0], v[1] = y[2] - y[0], v[2] = batch.k * (w[2] - w[0]);
        cross(u, v, n);
        area = root(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        if (index >= batch.fewest)
            for (int lane = 0; lane < WD; ++lane)
                if (index >= batch.count[lane]) area[lane] = 0;
    }

  private:
    void load_corners(const FanBlock &block, const vd &x0, const vd &y0, int j) {
        vd fields[4];
        gather(block, slot[j], fields);
        x[j] = fields[0] - x0, y[j] = fields[1] - y0, w[j] = fields[2], a[j] = fields[3];
    }
};

// Fills the moments of a batch. `depth_scale`: k of a fan at depth 1.
inline void find_moments(const FanBlock &block, double depth_scale, FanBatch &batch) {
    int32_t origin[WD];
    for (int lane = 0; lane < WD; ++lane) origin[lane] = block.index(3 * (int64_t)batch.first[lane]);
    vd origins[4];
    gather(block, origin, origins);
    const vd &x0 = origins[0], &y0 = origins[1], &w0 = origins[2];
    batch.k = depth_scale / w0;
    vd mass = {}, sx = {}, sy = {}, xx = {}, xy = {}, yy = {}, nearest = w0;
    FanTriangles t;
    for (int index = 0; index < batch.most; ++index) {
        t.load(block, batch, index, x0, y0);
        // Q = (x, y), B = (bx, by), and the sum of (a + 2 a_i) q_i q_i^T.
        const vd x = t.x[0] + t.x[1] + t.x[2], y = t.y[0] + t.y[1] + t.y[2];
        vd bx = {}, by = {}, txx = {}, txy = {}, tyy = {};
        for (int j = 0; j < 3; ++j) {
            const vd weight = t.alpha_sum + 2 * t.a[j];
            bx += t.a[j] * t.x[j];
            by += t.a[j] * t.y[j];
            txx += weight * t.x[j] * t.x[j];
            txy += weight * t.x[j] * t.y[j];
            tyy += weight * t.y[j] * t.y[j];
            nearest = t.w[j] < nearest ? t.w[j] : nearest;
        }
        mass += 20 * t.alpha_sum * t.area;
        sx += 5 * t.area * (t.alpha_sum * x + bx);
        sy += 5 * t.area * (t.alpha_sum * y + by);
        xx += t.area * (txx + x * (t.alpha_sum * x + 2 * bx));
        xy += t.area * (txy + t.alpha_sum * x * y + bx * y + by * x);
        yy += t.area * (tyy + y * (t.alpha_sum * y + 2 * by));
    }
    batch.nearest = nearest;
    batch.mass = mass;
    batch.inverse_mass = 1 / mass;
    const vd x = sx * batch.inverse_mass, y = sy * batch.inverse_mass;
    batch.x = x0 + x;
    batch.y = y0 + y;
    batch.m[0] = xx * batch.inverse_mass - x * x;
    batch.m[1] = xy * batch.inverse_mass - x * y;
    batch.m[2] = yy * batch.inverse_mass - y * y;
}

}  // namespace ms
