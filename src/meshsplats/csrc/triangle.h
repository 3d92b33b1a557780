// The mathematics of one triangle: projection, edge functions, perspective-correct interpolation.
//
// With camera-space corners V_i and the ray through the sample point p, E_i(p) = p . (V_j x V_k) is linear in
// the image, vanishes on the edge opposite to corner i, and b_i = E_i / (E_0 + E_1 + E_2) is the
// perspective-correct barycentric weight (homogeneous rasterization, Olano and Greer 1997). For corners in
// front of the camera E_i is the planar edge function (Pineda 1988) of the projected edge times z_j z_k.
// Swapping the ends of an edge negates its function exactly, whichever triangle it belongs to; with the
// top-left rule for samples on an edge, a sample on a shared edge therefore belongs to exactly one of the two
// triangles.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "check.h"
#include "simd.h"
#include "types.h"

namespace ms {

// A projected vertex: position in samples from the top left corner of the image, and w = 1 / depth; all 0 for
// a vertex nearer than the near plane.
struct Projected {
    double x, y, w;
};

struct Vec3 {
    double x, y, z;
};

// det(v_0, v_1, v_2) = v_0 . (v_1 x v_2).
inline double determinant(const Vec3 v[3]) {
    return v[0].x * (v[1].y * v[2].z - v[2].y * v[1].z) - v[0].y * (v[1].x * v[2].z - v[2].x * v[1].z) +
           v[0].z * (v[1].x * v[2].y - v[2].x * v[1].y);
}

// From world space to camera space and on to sample coordinates.
struct Projection {
    double m[12];  // world to camera, 3 x 4 row-major
    double fx, fy, cx, cy, near;

    Projection(const MsCamera &camera, int samples)
        : fx(camera.fx * samples),
          fy(camera.fy * samples),
          cx(camera.cx * samples),
          cy(camera.cy * samples),
          near(camera.near) {
        MS_ASSERT(near > 0);
        for (int i = 0; i < 12; ++i) m[i] = camera.world_to_camera[i];
    }
    Vec3 to_camera(const float *p) const {
        double x = p[0], y = p[1], z = p[2];
        return {m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7],
                m[8] * x + m[9] * y + m[10] * z + m[11]};
    }
    double depth(double x, double y, double z) const { return m[8] * x + m[9] * y + m[10] * z + m[11]; }
    Projected project(const Vec3 &c) const {
        if (!(c.z >= near)) return {0, 0, 0};
        double w = 1 / c.z;
        return {fx * c.x * w + cx, fy * c.y * w + cy, w};
    }
};

// The linear function a x + b y + c of a sample position.
struct Linear {
    double a, b, c;
};

// Triangle set-up of N triangles in SIMD lanes. Sample positions are relative to an origin that the caller
// chooses, such as the corner of a tile. All functions that a sample needs are linear in its position: the
// edge functions E_i, 1 / depth and b_i / depth.
template <int COUNT>
struct TriangleSetup {
    static constexpr int N = COUNT;

    // In: corners of projected triangles.
    alignas(64) double x[3][N], y[3][N], w[3][N];
    const float *rgba[3][N];
    int32_t face[N];

    // Out: coefficients a, b, c of linear functions.
    alignas(64) float ea[3][N], eb[3][N], ec[3][N];  // E_i, positive inside
    // A sample is inside where every E_i >= threshold: 0 for top and left edges, which own their samples,
    // else the smallest normal float.
    alignas(64) float threshold[3][N];
    alignas(64) float qa[N], qb[N], qc[N];           // q = 1 / depth
    alignas(64) float q_min[N], q_max[N];            // range of q over the corners
    alignas(64) float sa[3][N], sb[3][N], sc[3][N];  // s_i = b_i / depth
    alignas(64) float valid[N];                      // 1, or 0 for a triangle without area in the image

    // Sets up all N lanes for triangles entirely beyond the near plane. Results of unused lanes and of other
    // triangles have no meaning.
    void set_up_visible() {
        alignas(64) double scale[N], flip[N];
        for (int t = 0; t < N; ++t) {
            double d = (x[1][t] - x[0][t]) * (y[2][t] - y[0][t]) - (x[2][t] - x[0][t]) * (y[1][t] - y[0][t]);
            double size = std::fabs(d);
            valid[t] = is_valid(size) ? 1.0f : 0.0f;
            flip[t] = d < 0 ? -1.0 : 1.0;
            scale[t] = 1 / size;
        }
        alignas(64) double q[3][N];
        for (int t = 0; t < N; ++t) q[0][t] = q[1][t] = q[2][t] = 0;
        for (int i = 0; i < 3; ++i) {
            int j = (i + 1) % 3, k = (i + 2) % 3;
            for (int t = 0; t < N; ++t) {
                double a = flip[t] * (y[j][t] - y[k][t]), b = flip[t] * (x[k][t] - x[j][t]),
                       c = flip[t] * (x[j][t] * y[k][t] - x[k][t] * y[j][t]);
                double s = w[i][t] * scale[t];
                ea[i][t] = (float)a;
                eb[i][t] = (float)b;
                ec[i][t] = (float)c;
                sa[i][t] = (float)(a * s);
                sb[i][t] = (float)(b * s);
                sc[i][t] = (float)(c * s);
                q[0][t] += a * s;
                q[1][t] += b * s;
                q[2][t] += c * s;
            }
        }
        unsigned huge = 0;
        for (int i = 0; i < 3; ++i)
            for (int t = 0; t < N; ++t)
                huge |= (int)!(std::fabs(ea[i][t]) < HUGE_EDGE) | (int)!(std::fabs(eb[i][t]) < HUGE_EDGE) |
                        (int)!(std::fabs(ec[i][t]) < HUGE_EDGE);
        if (huge) set_huge_edges(flip);
        for (int t = 0; t < N; ++t) {
            qa[t] = (float)q[0][t];
            qb[t] = (float)q[1][t];
            qc[t] = (float)q[2][t];
        }
        for (int i = 0; i < 3; ++i)
            for (int t = 0; t < N; ++t) threshold[i][t] = edge_threshold(ea[i][t], eb[i][t]);
        for (int t = 0; t < N; ++t) {
            float w0 = (float)w[0][t], w1 = (float)w[1][t], w2 = (float)w[2][t];
            float least = w0 < w1 ? w0 : w1, most = w0 > w1 ? w0 : w1;
            q_min[t] = least < w2 ? least : w2;
            q_max[t] = most > w2 ? most : w2;
        }
    }

    // Whether the triangle in lane t has a corner nearer than the near plane: it needs set_up_clipped.
    bool is_clipped(int t) const { return !(w[0][t] > 0) | !(w[1][t] > 0) | !(w[2][t] > 0); }

    // Near-plane clipping: sets up lane t for a triangle with one or two corners nearer than the near plane,
    // whose w is 0. `v` are its corners in camera space with x and y scaled to samples relative to the origin
    // (x0, y0): (fx X + (cx - x0) Z, fy Y + (cy - y0) Z, Z). The caller discards samples with q > q_max.
    void set_up_clipped(int t, const Vec3 v[3], double near) {
        MS_ASSERT(t >= 0 && t < N);
        double det = determinant(v);
        double size = std::fabs(det), flip = det < 0 ? -1 : 1, scale = 1 / size, q[3] = {0, 0, 0};
        valid[t] = is_valid(size) ? 1.0f : 0.0f;
        for (int i = 0; i < 3; ++i) {
            int j = (i + 1) % 3, k = (i + 2) % 3;
            double a, b, c, s = scale;
            if (w[j][t] > 0 && w[k][t] > 0) {
                // The edge is visible. A neighbour may be entirely visible: use the function that it
                // computes.
                a = y[j][t] - y[k][t];
                b = x[k][t] - x[j][t];
                c = x[j][t] * y[k][t] - x[k][t] * y[j][t];
                s *= v[j].z * v[k].z;
            } else {
                a = v[j].y * v[k].z - v[k].y * v[j].z;
                b = v[k].x * v[j].z - v[j].x * v[k].z;
                c = v[j].x * v[k].y - v[k].x * v[j].y;
            }
            a *= flip;
            b *= flip;
            c *= flip;
            ea[i][t] = (float)a;
            eb[i][t] = (float)b;
            ec[i][t] = (float)c;
            set_huge_edge(i, t, a, b, c);
            threshold[i][t] = edge_threshold(ea[i][t], eb[i][t]);
            sa[i][t] = (float)(a * s);
            sb[i][t] = (float)(b * s);
            sc[i][t] = (float)(c * s);
            q[0] += a * s;
            q[1] += b * s;
            q[2] += c * s;
        }
        qa[t] = (float)q[0];
        qb[t] = (float)q[1];
        qc[t] = (float)q[2];
        // The visible part reaches from the near plane to the farthest corner.
        q_min[t] = (float)(1 / std::max({v[0].z, v[1].z, v[2].z}));
        q_max[t] = (float)(1 / near);
    }

  private:
    // Coefficients of edge functions from which on their sums at the samples of a tile might overflow float:
    // of triangles that reach as far as 1e15 samples, or scene units.
    static constexpr float HUGE_EDGE = 0x1p100f;

    void set_huge_edges(const double flip[N]) {
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, k = (i + 2) % 3;
            for (int t = 0; t < N; ++t)
                set_huge_edge(i, t, flip[t] * (y[j][t] - y[k][t]), flip[t] * (x[k][t] - x[j][t]),
                              flip[t] * (x[j][t] * y[k][t] - x[k][t] * y[j][t]));
        }
    }

    // Stores edge function i of lane t times a power of two that makes it fit, if it is so large: only its
    // sign matters, and from both sides of a shared edge the power is the same.
    void set_huge_edge(int i, int t, double a, double b, double c) {
        const double largest = std::max({std::fabs(a), std::fabs(b), std::fabs(c)});
        if (!(largest >= HUGE_EDGE && largest <= std::numeric_limits<double>::max())) return;
        const int power = std::ilogb(largest);
        ea[i][t] = (float)std::ldexp(a, -power);
        eb[i][t] = (float)std::ldexp(b, -power);
        ec[i][t] = (float)std::ldexp(c, -power);
    }

    // Whether 1 / size is finite and not 0.
    static bool is_valid(double size) { return size < 1e300 && size > 1e-300; }

    // Top-left rule (OpenGL, Direct3D), bit-exact: of two triangles at an edge, one sees (a, b) and the other
    // (-a, -b).
    static float edge_threshold(float a, float b) {
        return (a > 0) | ((a == 0) & (b > 0)) ? 0.0f : std::numeric_limits<float>::min();
    }
};

}  // namespace ms
