// A low-pass filter for fans: what a viewer of splats adds to the covariance of each on the picture, for triangles.
//
// The triangles of one splat are a fan. Its opacity, linear inside each triangle, is a density over the picture, of mean c and
// covariance M. A filter of variance s moves the projected vertices p to c + A (p - c) with A = (M + s I)^(1/2) M^(-1/2) =
// (I + s M^-1)^(1/2): the density then has the covariance M + s I. Depths and opacities stay as they are.
//
// For a triangle of area T with opacities a_i, sum a, at positions q_i, with Q = sum q_i and B = sum a_i q_i, the integrals of
// opacity times 1, q and q q^T over the triangle are
//     T a / 3,  T / 12 (a Q + B),  T / 60 (a Q Q^T + B Q^T + Q B^T + sum (a + 2 a_i) q_i q_i^T).
//
// Two limits need care. A fan seen edge on has no width in one direction, where its vertices' offsets would be multiplied
// without end: NARROWEST bounds that. Nor has it an area to weigh its triangles by: areas are those of triangles (x, y, k / z)
// with a k that counts depth as SIDEWAYS of what it is in the plane of the picture.
#pragma once

#include <stdexcept>

#include "large.h"
#include "parallel.h"
#include "triangle.h"

namespace ms {

struct SharedVertices : std::runtime_error {
    SharedVertices() : std::runtime_error("two splats share a vertex") {}
};

class FanFilter {
  public:
    FanFilter(const MsMesh &mesh, const Projection &projection, int samples)
        : mesh_(mesh), projection_(projection), variance_(mesh.filter_px2 * samples * samples),
          depth_scale_(SIDEWAYS * std::sqrt(projection.fx * projection.fy)) {}

    // Moves all vertices that triangles use. A fan that reaches nearer than the near plane or has no area stays as it is.
    // Throws SharedVertices.
    void apply(const Large<Projected> &from, Large<Projected> &to, int threads) {
        owner_.resize(mesh_.vertex_count);
        to.resize(mesh_.vertex_count);
        each_fan(threads, [&](int64_t first) {
            return each_corner(first, [&](int32_t v) { __atomic_store_n(&owner_[v], (int32_t)first, __ATOMIC_RELAXED); });
        });
        std::atomic<bool> shared{false};
        each_fan(threads, [&](int64_t first) {
            const Fan fan = measure(from, first);
            return each_corner(first, [&](int32_t v) {
                if (owner_[v] != (int32_t)first) {
                    shared = true;
                    return;
                }
                const Projected &p = from[v];
                if (!fan.moves) {
                    to[v] = p;
                    return;
                }
                const double x = p.x - fan.x, y = p.y - fan.y;
                to[v] = {fan.x + (fan.a[0] * x + fan.a[1] * y), fan.y + (fan.a[1] * x + fan.a[2] * y), p.w};
            });
        });
        if (shared) throw SharedVertices();
    }

    // Adds to `out` the gradients of positions and opacities that follow from `towards`, those of the moved vertices in camera
    // space. After `apply`.
    void back(const Large<Projected> &from, const Large<Projected> &to, const float *towards, const MsVertexGradients &out,
              int threads) {
        pulled_.resize(mesh_.vertex_count);
        each_fan(threads, [&](int64_t first) {
            const Fan fan = measure(from, first);
            if (!fan.moves) {
                each_vertex(first, fan.end, (int32_t)first, [&](int32_t v) {
                    const float *g = towards + 3 * (int64_t)v;
                    add_position(v, g[0], g[1], g[2], out);
                });
                return fan.end;
            }
            const Influence influence = pull_positions(fan, first, from, to, towards);
            pull_density(fan, influence, first, from);
            each_vertex(first, fan.end, ~(int32_t)first, [&](int32_t v) {
                const Pulled &g = pulled_[v];
                const Projected &p = from[v];
                add_position(v, g.x * projection_.fx * p.w, g.y * projection_.fy * p.w,
                             g.z - (g.x * (p.x - projection_.cx) + g.y * (p.y - projection_.cy)) * p.w, out);
                out.colors[4 * (int64_t)v + 3] += (float)g.alpha;
            });
            return fan.end;
        });
    }

  private:
    static constexpr double NARROWEST = 1e-4;  // of the filter's variance
    static constexpr double SIDEWAYS = 0.1;
    static constexpr double FAINTEST = 1e-6;   // added to opacities, so that fans without any have a shape, too

    struct Fan {
        int64_t end;
        bool moves;
        double x, y;     // mean
        double mass;     // 60 times the integral of opacity over twice the areas
        double m[3];     // covariance: xx, xy, yy
        double k;        // of depths
        double a[3];     // A
    };
    // How the loss changes with the density at q from the mean: (q^T h q + c . q - level) / mass.
    struct Influence {
        double h[3], c[2], level;
    };
    struct Pulled {
        double x, y;  // on the picture
        double z;     // camera depth
        double alpha;
    };
    struct Corners {
        double x[3], y[3], w[3], a[3], sum;  // from an origin
        double u[3], v[3], n[3];             // edges 0 to 1 and 0 to 2 in (x, y, k / z), and their product
        double area;                         // twice
    };

    // Calls body(first triangle) for each fan; it returns the end of the fan.
    template <class Body>
    void each_fan(int threads, Body body) const {
        const int32_t *splat = mesh_.face_splat;
        parallel_blocks(threads, mesh_.face_count, 1 << 13, [&](int64_t a, int64_t b, int) {
            int64_t i = a;
            while (i > 0 && i < b && splat[i] == splat[i - 1]) ++i;
            while (i < b) i = body(i);
        });
    }
    template <class Body>
    int64_t each_corner(int64_t first, Body body) const {
        int64_t i = first;
        do {
            const int32_t *f = mesh_.faces + 3 * i;
            for (int k = 0; k < 3; ++k) body(f[k]);
        } while (++i < mesh_.face_count && mesh_.face_splat[i] == mesh_.face_splat[first]);
        return i;
    }
    // Calls body(vertex) once for each vertex of a fan; those with the mark have not been met.
    template <class Body>
    void each_vertex(int64_t first, int64_t end, int32_t mark, Body body) {
        for (const int32_t *f = mesh_.faces + 3 * first; f < mesh_.faces + 3 * end; ++f) {
            if (owner_[*f] != mark) continue;
            owner_[*f] = ~mark;
            body(*f);
        }
    }

    Corners corners(const Large<Projected> &from, const int32_t *face, double x0, double y0, double k) const {
        Corners c;
        for (int i = 0; i < 3; ++i) {
            const Projected &p = from[face[i]];
            c.x[i] = p.x - x0;
            c.y[i] = p.y - y0;
            c.w[i] = p.w;
            c.a[i] = mesh_.colors[4 * (int64_t)face[i] + 3] + FAINTEST;
        }
        c.sum = c.a[0] + c.a[1] + c.a[2];
        const double u[3] = {c.x[1] - c.x[0], c.y[1] - c.y[0], k * (c.w[1] - c.w[0])},
                     v[3] = {c.x[2] - c.x[0], c.y[2] - c.y[0], k * (c.w[2] - c.w[0])};
        cross(u, v, c.n);
        for (int i = 0; i < 3; ++i) {
            c.u[i] = u[i];
            c.v[i] = v[i];
        }
        c.area = std::sqrt(c.n[0] * c.n[0] + c.n[1] * c.n[1] + c.n[2] * c.n[2]);
        return c;
    }

    Fan measure(const Large<Projected> &from, int64_t first) const {
        const int32_t *face = mesh_.faces + 3 * first;
        const Projected &origin = from[face[0]];
        Fan fan;
        fan.k = origin.w > 0 ? depth_scale_ / origin.w : 0;
        bool in_front = true;
        double mass = 0, sx = 0, sy = 0, xx = 0, xy = 0, yy = 0;
        int64_t i = first;
        do {
            const Corners c = corners(from, face, origin.x, origin.y, fan.k);
            in_front &= (c.w[0] > 0) & (c.w[1] > 0) & (c.w[2] > 0);
            const double x = c.x[0] + c.x[1] + c.x[2], y = c.y[0] + c.y[1] + c.y[2];
            double bx = 0, by = 0, txx = 0, txy = 0, tyy = 0;
            for (int j = 0; j < 3; ++j) {
                const double more = c.sum + 2 * c.a[j];
                bx += c.a[j] * c.x[j];
                by += c.a[j] * c.y[j];
                txx += more * c.x[j] * c.x[j];
                txy += more * c.x[j] * c.y[j];
                tyy += more * c.y[j] * c.y[j];
            }
            mass += 20 * c.sum * c.area;
            sx += 5 * c.area * (c.sum * x + bx);
            sy += 5 * c.area * (c.sum * y + by);
            xx += c.area * (txx + x * (c.sum * x + 2 * bx));
            xy += c.area * (txy + c.sum * x * y + bx * y + by * x);
            yy += c.area * (tyy + y * (c.sum * y + 2 * by));
            face += 3;
        } while (++i < mesh_.face_count && mesh_.face_splat[i] == mesh_.face_splat[first]);
        fan.end = i;
        fan.mass = mass;
        const double x = sx / mass, y = sy / mass;
        fan.x = origin.x + x;
        fan.y = origin.y + y;
        fan.m[0] = xx / mass - x * x;
        fan.m[1] = xy / mass - x * y;
        fan.m[2] = yy / mass - y * y;
        const Inverse inverse = inverted(fan);
        const double s = variance_, b[3] = {1 + s * inverse.m[0], s * inverse.m[1], 1 + s * inverse.m[2]},
                     root = std::sqrt(1 + s * (inverse.m[0] + inverse.m[2]) + s * s / inverse.det),
                     scale = 1 / std::sqrt(b[0] + b[2] + 2 * root);
        fan.a[0] = (b[0] + root) * scale;
        fan.a[1] = b[1] * scale;
        fan.a[2] = (b[2] + root) * scale;
        fan.moves = in_front & (mass > 0) & (inverse.det > 0) & (fan.a[0] + std::fabs(fan.a[1]) + fan.a[2] < 1e30);
        return fan;
    }

    // Of the covariance, no narrower than NARROWEST.
    struct Inverse {
        double m[3], det;
    };
    Inverse inverted(const Fan &fan) const {
        const double least = NARROWEST * variance_, xx = fan.m[0] + least, xy = fan.m[1], yy = fan.m[2] + least,
                     det = xx * yy - xy * xy;
        return {{yy / det, -xy / det, xx / det}, det};
    }

    // The gradients of the places that vertices have with A and c as they are; and what that says of A and c.
    Influence pull_positions(const Fan &fan, int64_t first, const Large<Projected> &from, const Large<Projected> &to,
                             const float *towards) {
        const double *a = fan.a;
        double g[3] = {0, 0, 0};
        Influence found{};
        each_vertex(first, fan.end, (int32_t)first, [&](int32_t v) {
            const Projected &p = from[v], &q = to[v];
            const float *t = towards + 3 * (int64_t)v;
            const double x = t[0] / (projection_.fx * p.w), y = t[1] / (projection_.fy * p.w),
                         z = t[2] + (x * (q.x - projection_.cx) + y * (q.y - projection_.cy)) * p.w,
                         dx = p.x - fan.x, dy = p.y - fan.y;
            g[0] += x * dx;
            g[1] += 0.5 * (x * dy + y * dx);
            g[2] += y * dy;
            const Pulled pulled = {a[0] * x + a[1] * y, a[1] * x + a[2] * y, z, 0};
            found.c[0] += x - pulled.x;
            found.c[1] += y - pulled.y;
            pulled_[v] = pulled;
        });
        // A A = I + s M^-1: A X + X A = g has X = (det A g + adj A g adj A) / (2 tr A det A), and h = -s M^-1 X M^-1.
        const double det = a[0] * a[2] - a[1] * a[1], share = 1 / (2 * (a[0] + a[2]) * det), adjoint[3] = {a[2], -a[1], a[0]};
        double x[3], around[3];
        between(adjoint, g, around);
        for (int i = 0; i < 3; ++i) x[i] = (det * g[i] + around[i]) * share;
        const Inverse inverse = inverted(fan);
        between(inverse.m, x, found.h);
        for (double &h : found.h) h *= -variance_;
        found.level = found.h[0] * fan.m[0] + 2 * found.h[1] * fan.m[1] + found.h[2] * fan.m[2];
        return found;
    }

    // Adds the gradients by way of the density, whose moments A and c are.
    void pull_density(const Fan &fan, const Influence &influence, int64_t first, const Large<Projected> &from) {
        const double *h = influence.h, *c = influence.c;
        const int32_t root = mesh_.faces[3 * first];
        double to_k = 0;
        for (int64_t i = first; i < fan.end; ++i) {
            const int32_t *face = mesh_.faces + 3 * i;
            const Corners t = corners(from, face, fan.x, fan.y, fan.k);
            if (!(t.area > 0)) continue;
            double hx[3], hy[3], square[3], straight[3];
            for (int j = 0; j < 3; ++j) {
                hx[j] = h[0] * t.x[j] + h[1] * t.y[j];
                hy[j] = h[1] * t.x[j] + h[2] * t.y[j];
                square[j] = hx[j] * t.x[j] + hy[j] * t.y[j];
                straight[j] = c[0] * t.x[j] + c[1] * t.y[j];
            }
            const double qx = t.x[0] + t.x[1] + t.x[2], qy = t.y[0] + t.y[1] + t.y[2], hqx = hx[0] + hx[1] + hx[2],
                         hqy = hy[0] + hy[1] + hy[2], whole = qx * hqx + qy * hqy, squares = square[0] + square[1] + square[2],
                         lines = straight[0] + straight[1] + straight[2];
            const double hbx = t.a[0] * hx[0] + t.a[1] * hx[1] + t.a[2] * hx[2],
                         hby = t.a[0] * hy[0] + t.a[1] * hy[1] + t.a[2] * hy[2];
            const double share = t.area / fan.mass;
            double value = 0, to[3][3];
            for (int j = 0; j < 3; ++j) {
                const double by_alpha = whole + 2 * (t.x[j] * hqx + t.y[j] * hqy) + squares + 2 * square[j] +
                                        5 * (lines + straight[j]) - 20 * influence.level;
                pulled_[face[j]].alpha += share * by_alpha;
                value += t.a[j] * by_alpha;
                const double one = 2 * (t.sum + t.a[j]), two = 2 * (t.sum + 2 * t.a[j]), five = 5 * (t.sum + t.a[j]);
                to[j][0] = share * (one * hqx + 2 * hbx + two * hx[j] + five * c[0]);
                to[j][1] = share * (one * hqy + 2 * hby + two * hy[j] + five * c[1]);
                to[j][2] = 0;
            }
            // By the triangle's area: its integral, linear in the opacities, is `value` times it.
            double of_n[3], of_u[3], of_v[3];
            for (int j = 0; j < 3; ++j) of_n[j] = value / fan.mass * t.n[j] / t.area;
            cross(t.v, of_n, of_u);
            cross(of_n, t.u, of_v);
            for (int j = 0; j < 3; ++j) {
                to[0][j] -= of_u[j] + of_v[j];
                to[1][j] += of_u[j];
                to[2][j] += of_v[j];
            }
            for (int j = 0; j < 3; ++j) {
                Pulled &pulled = pulled_[face[j]];
                pulled.x += to[j][0];
                pulled.y += to[j][1];
                pulled.z -= to[j][2] * fan.k * t.w[j] * t.w[j];
                to_k += to[j][2] * t.w[j];
            }
        }
        pulled_[root].z += to_k * fan.k * from[root].w;  // k is in proportion to its depth
    }

    void add_position(int32_t v, double x, double y, double z, const MsVertexGradients &out) const {
        const double *m = projection_.m;
        for (int j = 0; j < 3; ++j) out.vertices[3 * (int64_t)v + j] += (float)(m[j] * x + m[4 + j] * y + m[8 + j] * z);
    }

    static void cross(const double a[3], const double b[3], double out[3]) {
        out[0] = a[1] * b[2] - a[2] * b[1];
        out[1] = a[2] * b[0] - a[0] * b[2];
        out[2] = a[0] * b[1] - a[1] * b[0];
    }
    // a b a of symmetric matrices.
    static void between(const double a[3], const double b[3], double out[3]) {
        const double p = a[0] * b[0] + a[1] * b[1], q = a[0] * b[1] + a[1] * b[2], r = a[1] * b[0] + a[2] * b[1],
                     t = a[1] * b[1] + a[2] * b[2];
        out[0] = p * a[0] + q * a[1];
        out[1] = p * a[1] + q * a[2];
        out[2] = r * a[1] + t * a[2];
    }

    const MsMesh &mesh_;
    const Projection &projection_;
    const double variance_;     // square samples
    const double depth_scale_;  // k for a fan at depth 1
    Large<int32_t> owner_;      // first triangle of the fan that has the vertex
    Large<Pulled> pulled_;
};

}  // namespace ms
