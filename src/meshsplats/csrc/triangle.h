// The mathematics of one triangle: projection, edge functions, perspective-correct interpolation.
//
// With camera-space corners V_i and a ray through the sample point p, E_i(p) = p . (V_j x V_k) is linear on the
// picture, vanishes on the edge opposite to corner i, and b_i = E_i / (E_0 + E_1 + E_2) is the perspective-correct
// barycentric weight (Olano and Greer 1997). For corners in front of the camera E_i is the planar edge function of
// the projected edge times z_j z_k. Swapping the ends of an edge negates its function to the last bit, whichever
// triangle it belongs to, so that a sample on a shared edge falls to exactly one of the two.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "simd.h"
#include "types.h"

namespace ms {

// A projected vertex: samples from the top left corner, and 1 / depth (0 marks one nearer than the near plane).
struct Projected {
    double x, y, w;
};

struct Vec3 {
    double x, y, z;
};

// World to camera and camera to sample coordinates.
struct Projection {
    double m[12];
    double fx, fy, cx, cy, near;

    Projection(const MsCamera &camera, int samples)
        : fx(camera.fx * samples), fy(camera.fy * samples), cx(camera.cx * samples), cy(camera.cy * samples),
          near(camera.near) {
        for (int i = 0; i < 12; ++i) m[i] = camera.world_to_camera[i];
    }
    Vec3 to_camera(const float *p) const {
        double x = p[0], y = p[1], z = p[2];
        return {m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7],
                m[8] * x + m[9] * y + m[10] * z + m[11]};
    }
    Projected project(const Vec3 &c) const {
        if (!(c.z >= near)) return {0, 0, 0};
        double w = 1 / c.z;
        return {fx * c.x * w + cx, fy * c.y * w + cy, w};
    }
};

// A function a x + b y + c of the sample position.
struct Linear {
    double a, b, c;
};

// One triangle made ready for a tile; positions count from the tile's corner. `value` holds RGBA divided by depth.
struct Triangle {
    float ea[3], eb[3], ec[3];  // edge functions, positive inside
    float threshold[3];         // 0 where samples on the edge belong to this triangle, else the least normal float
    float qa, qb, qc;           // 1 / depth
    float q_min, q_max;         // its range over the corners
    float ka, kb, kc;           // 1 / depth by which fragments are ordered
    float k_min, k_max;
    float weight[3];            // b_i is proportional to E_i weight_i
    int32_t face;
    int32_t y0, y1, x0, x1;     // samples of the tile that may be covered
    f4 va, vb, vc;              // RGBA / depth
    f4 low, high;               // RGBA range over the corners
};

inline float edge_threshold(double a, double b) {
    bool top_left = a > 0 || (a == 0 && b > 0);
    return top_left ? 0.0f : std::numeric_limits<float>::min();
}

// Fills `t` but for face, box and ordering; false if the triangle has no area on the picture.
// `p` are the corners relative to the tile. Corners nearer than the near plane (w == 0) need `behind`: all corners
// in camera space with x and y scaled to samples and moved to the tile, (fx X + (cx - x0) Z, fy Y + (cy - y0) Z, Z).
inline bool set_up(Triangle &t, const Projected p[3], const Vec3 *behind, double near, const float *const rgba[3]) {
    Linear e[3];
    double weight[3];  // makes the e[i] comparable: E_i of the header comment is e_i weight_i
    double scale;      // 1 / depth = scale * sum of e_i weight_i
    double flip;
    if (!behind) {
        double area = (p[1].x - p[0].x) * (p[2].y - p[0].y) - (p[2].x - p[0].x) * (p[1].y - p[0].y);
        if (!(area != 0) || !std::isfinite(area)) return false;
        flip = area < 0 ? -1 : 1;
        scale = 1 / std::fabs(area);
        for (int i = 0; i < 3; ++i) weight[i] = p[i].w;
    } else {
        const Vec3 *v = behind;
        double det = v[0].x * (v[1].y * v[2].z - v[2].y * v[1].z) - v[0].y * (v[1].x * v[2].z - v[2].x * v[1].z) +
                     v[0].z * (v[1].x * v[2].y - v[2].x * v[1].y);
        if (!(det != 0) || !std::isfinite(det)) return false;
        flip = det < 0 ? -1 : 1;
        scale = 1 / std::fabs(det);
        for (int i = 0; i < 3; ++i) {
            const Projected &a = p[(i + 1) % 3], &b = p[(i + 2) % 3];
            weight[i] = a.w > 0 && b.w > 0 ? v[(i + 1) % 3].z * v[(i + 2) % 3].z : 1;
        }
    }
    for (int i = 0; i < 3; ++i) {
        const Projected &a = p[(i + 1) % 3], &b = p[(i + 2) % 3];
        if (a.w > 0 && b.w > 0) {
            e[i] = {a.y - b.y, b.x - a.x, a.x * b.y - b.x * a.y};
        } else {
            const Vec3 &c = behind[(i + 1) % 3], &d = behind[(i + 2) % 3];
            e[i] = {c.y * d.z - d.y * c.z, d.x * c.z - c.x * d.z, c.x * d.y - d.x * c.y};
        }
        e[i] = {flip * e[i].a, flip * e[i].b, flip * e[i].c};
        t.ea[i] = (float)e[i].a;
        t.eb[i] = (float)e[i].b;
        t.ec[i] = (float)e[i].c;
        t.threshold[i] = edge_threshold(t.ea[i], t.eb[i]);
        t.weight[i] = (float)(weight[i] * scale);
        double s = weight[i] * scale;
        e[i] = {e[i].a * s, e[i].b * s, e[i].c * s};
    }
    t.qa = (float)(e[0].a + e[1].a + e[2].a);
    t.qb = (float)(e[0].b + e[1].b + e[2].b);
    t.qc = (float)(e[0].c + e[1].c + e[2].c);
    float w[3] = {(float)p[0].w, (float)p[1].w, (float)p[2].w};
    if (behind) {
        // The part in front of the near plane reaches from there to the farthest corner.
        double far_z = std::max({behind[0].z, behind[1].z, behind[2].z});
        t.q_min = (float)(1 / far_z);
        t.q_max = (float)(1 / near);
    } else {
        t.q_min = std::min({w[0], w[1], w[2]});
        t.q_max = std::max({w[0], w[1], w[2]});
    }
    f4 c0 = load4(rgba[0]), c1 = load4(rgba[1]), c2 = load4(rgba[2]);
    auto mix = [&](double a, double b, double c) { return set4((float)a) * c0 + set4((float)b) * c1 + set4((float)c) * c2; };
    t.va = mix(e[0].a, e[1].a, e[2].a);
    t.vb = mix(e[0].b, e[1].b, e[2].b);
    t.vc = mix(e[0].c, e[1].c, e[2].c);
    t.low = min4(min4(c0, c1), c2);
    t.high = max4(max4(c0, c1), c2);
    return true;
}

}  // namespace ms
