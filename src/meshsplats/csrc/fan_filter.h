// A low-pass filter for fans: what a viewer of splats adds to the covariance of each on the picture, for
// triangles.
//
// The triangles of one splat are a fan. Its opacity, linear inside each triangle, is a density over the
// picture, of mean c and covariance M. A filter of variance s moves the projected vertices p to c + A (p - c)
// with A = (M + s I)^(1/2) M^(-1/2) = (I + s M^-1)^(1/2): the density then has the covariance M + s I. Depths
// and opacities stay as they are.
//
// For a triangle of area T with opacities a_i, sum a, at positions q_i, with Q = sum q_i and B = sum a_i q_i,
// the integrals of opacity times 1, q and q q^T over the triangle are
//     T a / 3,  T / 12 (a Q + B),  T / 60 (a Q Q^T + B Q^T + Q B^T + sum (a + 2 a_i) q_i q_i^T).
//
// Two limits need care. A fan seen edge on has no width in one direction, where its vertices' offsets would
// be multiplied without end: NARROWEST bounds that. Nor has it an area to weigh its triangles by: areas are
// those of triangles (x, y, k / z) with a k that counts depth as SIDEWAYS of what it is in the plane of the
// picture.
#pragma once

#include <cstring>
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
    // Moves the projected vertices that triangles use. A fan that reaches nearer than the near plane or has
    // no area stays as it is. Keeps what the way back needs; the arrays of the mesh must stay as they are.
    // Throws SharedVertices.
    FanFilter(const MsMesh &mesh, const Projection &projection, int samples, Large<Projected> &&plain,
              int threads)
        : mesh_(mesh),
          projection_(projection),
          variance_(mesh.filter_px2 * samples * samples),
          depth_scale_(SIDEWAYS * std::sqrt(projection.fx * projection.fy)),
          plain_(std::move(plain)),
          moved_(mesh.vertex_count),
          owner_(mesh.vertex_count) {
        for (int64_t i = 0; i < mesh.face_count; ++i)
            if (i == 0 || mesh.face_splat[i] != mesh.face_splat[i - 1]) starts_.push_back((int32_t)i);
        fans_.resize(starts_.size());
        starts_.push_back((int32_t)mesh.face_count);
        fan_blocks(threads, [&](int32_t begin, int32_t end, int) {
            for (int32_t fan = begin; fan < end; ++fan)
                each_corner(fan, [&](int32_t v) { __atomic_store_n(&owner_[v], fan, __ATOMIC_RELAXED); });
        });
        std::atomic<bool> shared{false};
        fan_blocks(threads, [&](int32_t begin, int32_t end, int) {
            // One after the other, for each step of `solve` waits for the last, but not for other fans.
            for (int32_t fan = begin; fan < end; ++fan) measure(fan);
            for (int32_t fan = begin; fan < end; ++fan) solve(fans_[fan]);
            bool clash = false;
            for (int32_t number = begin; number < end; ++number) {
                const Fan &fan = fans_[number];
                each_corner(number, [&](int32_t v) {
                    const Projected p = plain_[v];
                    if (owner_[v] != number) {
                        clash = true;
                    } else if (!fan.moves) {
                        moved_[v] = p;
                    } else {
                        const double x = p.x - fan.x, y = p.y - fan.y;
                        moved_[v] = {fan.x + (fan.a[0] * x + fan.a[1] * y),
                                     fan.y + (fan.a[1] * x + fan.a[2] * y), p.w};
                    }
                });
            }
            if (clash) shared = true;
        });
        if (shared) throw SharedVertices();
    }

    const Projected *moved() const { return moved_.data(); }

    // Adds to `out` the gradients of positions and opacities that follow from `towards`, those of the moved
    // vertices in camera space.
    void back(const float *towards, const MsVertexGradients &out, int threads) const {
        Large<int32_t> met(owner_);  // then: -1 - place of the vertex among its fan's
        std::vector<std::vector<Pulled>> work(threads);
        fan_blocks(threads, [&](int32_t begin, int32_t end, int thread) {
            std::vector<Pulled> &pulled = work[thread];
            for (int32_t number = begin; number < end; ++number) {
                const Fan &fan = fans_[number];
                const size_t most = 3 * (size_t)(starts_[number + 1] - starts_[number]);
                if (pulled.size() < most) pulled.resize(most);
                int count = 0;
                bool any = false;
                each_corner(number, [&](int32_t v) {
                    if (met[v] != number) return;
                    met[v] = -1 - count;
                    pulled[count++].vertex = v;
                    const float *g = towards + 3 * (int64_t)v;
                    any |= (g[0] != 0) | (g[1] != 0) | (g[2] != 0);
                });
                if (!any) continue;
                if (!fan.moves) {
                    for (int i = 0; i < count; ++i) {
                        const float *g = towards + 3 * (int64_t)pulled[i].vertex;
                        add_position(pulled[i].vertex, g[0], g[1], g[2], out);
                    }
                    continue;
                }
                pull_density(number, pull_positions(fan, towards, pulled.data(), count), met.data(),
                             pulled.data());
                for (int i = 0; i < count; ++i) {
                    const Pulled &g = pulled[i];
                    const Projected &p = plain_[g.vertex];
                    add_position(g.vertex, g.x * projection_.fx * p.w, g.y * projection_.fy * p.w,
                                 g.z - (g.x * (p.x - projection_.cx) + g.y * (p.y - projection_.cy)) * p.w,
                                 out);
                    out.colors[4 * (int64_t)g.vertex + 3] += (float)g.alpha;
                }
            }
        });
    }

  private:
    static constexpr double NARROWEST = 1e-4;  // of the filter's variance
    static constexpr double SIDEWAYS = 0.1;
    static constexpr double FAINTEST =
        1e-6;  // added to opacities, so that fans without any have a shape, too

    struct Fan {
        double share;  // 1 / (60 times the integral of opacity over twice the areas); before `solve`, without
                       // the 1 /
        double x, y;   // mean; before, from the origin and over `share`
        double m[3];   // covariance: xx, xy, yy; before, likewise
        double x0, y0;  // origin
        double k;       // of depths
        double a[3];    // A
        bool moves;
    };
    // How the loss changes with the density at q from the mean: (q^T h q + c . q - level) times the fan's
    // share.
    struct Influence {
        double h[3], c[2], level;
    };
    // Gradients of a vertex.
    struct Pulled {
        int32_t vertex;
        double x, y;  // of its place on the picture
        double z;     // of its camera depth
        double alpha;
    };
    // Triangles are taken eight at a time. Lanes are summed in one order.
    typedef double Eight __attribute__((vector_size(64)));
    static constexpr int EIGHT = 8;
    struct Corners {
        Eight x[3], y[3], w[3], a[3];  // from an origin; 0 in lanes without a triangle
        Eight sum;                     // of opacities
        Eight u[3], v[3], n[3];        // edges 0 to 1 and 0 to 2 in (x, y, k / z), and their product
        Eight area;                    // twice
        int held;
        bool in_front;
    };

    template <class Body>
    void fan_blocks(int threads, Body body) const {
        parallel_blocks(threads, (int64_t)fans_.size(), 1 << 10, [&](int64_t begin, int64_t end, int thread) {
            body((int32_t)begin, (int32_t)end, thread);
        });
    }
    // Calls body(vertex) for each vertex of a fan, for some more than once; for few where triangles list the
    // same vertex first and go on where the last one ended.
    template <class Body>
    __attribute__((always_inline)) void each_corner(int32_t fan, Body body) const {
        int32_t head = -1, tail = -1;
        for (int64_t i = starts_[fan]; i < starts_[fan + 1]; ++i) {
            const int32_t *f = mesh_.faces + 3 * i;
            if (f[0] != head) body(f[0]);
            if (f[1] != tail) body(f[1]);
            body(f[2]);
            head = f[0], tail = f[2];
        }
    }

    // Of up to eight triangles, from `i` on and before `end`.
    __attribute__((always_inline)) void corners(int64_t i, int64_t end, double x0, double y0, double k,
                                                Corners &c) const {
        c.in_front = true;
        c.held = (int)std::min<int64_t>(EIGHT, end - i);
        for (int j = 0; j < 3 && c.held < EIGHT; ++j) c.x[j] = c.y[j] = c.w[j] = c.a[j] = Eight{};
        const int32_t *face = mesh_.faces + 3 * i;
        for (int lane = 0; lane < c.held; ++lane) {
            for (int j = 0; j < 3; ++j) {
                const int64_t v = *face++;
                const Projected &p = plain_[v];
                c.x[j][lane] = p.x - x0;
                c.y[j][lane] = p.y - y0;
                c.w[j][lane] = p.w;
                c.a[j][lane] = mesh_.colors[4 * v + 3] + FAINTEST;
                c.in_front &= p.w > 0;
            }
        }
        c.sum = c.a[0] + c.a[1] + c.a[2];
        c.u[0] = c.x[1] - c.x[0], c.u[1] = c.y[1] - c.y[0], c.u[2] = k * (c.w[1] - c.w[0]);
        c.v[0] = c.x[2] - c.x[0], c.v[1] = c.y[2] - c.y[0], c.v[2] = k * (c.w[2] - c.w[0]);
        cross(c.u, c.v, c.n);
        const Eight square = c.n[0] * c.n[0] + c.n[1] * c.n[1] + c.n[2] * c.n[2];
        for (int lane = 0; lane < EIGHT; ++lane) c.area[lane] = std::sqrt(square[lane]);
    }

    void measure(int32_t number) {
        const int64_t first = starts_[number], end = starts_[number + 1];
        const Projected &origin = plain_[mesh_.faces[3 * first]];
        Fan &fan = fans_[number];
        fan.k = origin.w > 0 ? depth_scale_ / origin.w : 0;
        bool in_front = true;
        Corners c;
        Eight mass = {}, sx = {}, sy = {}, xx = {}, xy = {}, yy = {};
        for (int64_t i = first; i < end; i += EIGHT) {
            corners(i, end, origin.x, origin.y, fan.k, c);
            in_front &= c.in_front;
            const Eight x = c.x[0] + c.x[1] + c.x[2], y = c.y[0] + c.y[1] + c.y[2];
            Eight bx = {}, by = {}, txx = {}, txy = {}, tyy = {};
            for (int j = 0; j < 3; ++j) {
                const Eight more = c.sum + 2 * c.a[j];
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
        }
        fan.share = total(mass);
        fan.x = total(sx);
        fan.y = total(sy);
        fan.m[0] = total(xx);
        fan.m[1] = total(xy);
        fan.m[2] = total(yy);
        fan.x0 = origin.x;
        fan.y0 = origin.y;
        fan.moves = in_front;
    }

    void solve(Fan &fan) const {
        const bool solid = fan.share > 0;
        fan.share = 1 / fan.share;
        const double x = fan.x * fan.share, y = fan.y * fan.share;
        fan.x = fan.x0 + x;
        fan.y = fan.y0 + y;
        fan.m[0] = fan.m[0] * fan.share - x * x;
        fan.m[1] = fan.m[1] * fan.share - x * y;
        fan.m[2] = fan.m[2] * fan.share - y * y;
        const Inverse inverse = inverted(fan);
        const double s = variance_, b[3] = {1 + s * inverse.m[0], s * inverse.m[1], 1 + s * inverse.m[2]},
                     root = std::sqrt(1 + s * (inverse.m[0] + inverse.m[2]) + s * s * inverse.share),
                     scale = 1 / std::sqrt(b[0] + b[2] + 2 * root);
        fan.a[0] = (b[0] + root) * scale;
        fan.a[1] = b[1] * scale;
        fan.a[2] = (b[2] + root) * scale;
        fan.moves =
            fan.moves & solid & (inverse.share > 0) & (fan.a[0] + std::fabs(fan.a[1]) + fan.a[2] < 1e30);
    }

    // Of the covariance, no narrower than NARROWEST.
    struct Inverse {
        double m[3], share;  // and 1 / determinant
    };
    Inverse inverted(const Fan &fan) const {
        const double least = NARROWEST * variance_, xx = fan.m[0] + least, xy = fan.m[1],
                     yy = fan.m[2] + least, share = 1 / (xx * yy - xy * xy);
        return {{yy * share, -xy * share, xx * share}, share};
    }

    // The gradients of the places that vertices have with A and c as they are; and what that says of A and c.
    Influence pull_positions(const Fan &fan, const float *towards, Pulled *pulled, int count) const {
        const double *a = fan.a, unit_x = 1 / projection_.fx, unit_y = 1 / projection_.fy;
        double g[3] = {0, 0, 0};
        Influence found{};
        for (int i = 0; i < count; ++i) {
            Pulled &to = pulled[i];
            const Projected &p = plain_[to.vertex], &q = moved_[to.vertex];
            const float *t = towards + 3 * (int64_t)to.vertex;
            const double z = 1 / p.w, x = t[0] * unit_x * z, y = t[1] * unit_y * z, dx = p.x - fan.x,
                         dy = p.y - fan.y;
            g[0] += x * dx;
            g[1] += 0.5 * (x * dy + y * dx);
            g[2] += y * dy;
            to.x = a[0] * x + a[1] * y;
            to.y = a[1] * x + a[2] * y;
            to.z = t[2] + (x * (q.x - projection_.cx) + y * (q.y - projection_.cy)) * p.w;
            found.c[0] += x - to.x;
            found.c[1] += y - to.y;
            to.alpha = 0;
        }
        // A A = I + s M^-1: A X + X A = g has X = (det A g + adj A g adj A) / (2 tr A det A), and h = -s M^-1
        // X M^-1.
        const double det = a[0] * a[2] - a[1] * a[1], share = 1 / (2 * (a[0] + a[2]) * det),
                     adjoint[3] = {a[2], -a[1], a[0]};
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
    void pull_density(int32_t number, const Influence &influence, const int32_t *place,
                      Pulled *pulled) const {
        const Fan &fan = fans_[number];
        const double *h = influence.h, *c = influence.c;
        const int64_t first = starts_[number], end = starts_[number + 1];
        double to_k = 0;
        Corners t;
        for (int64_t i = first; i < end; i += EIGHT) {
            corners(i, end, fan.x, fan.y, fan.k, t);
            Eight hx[3], hy[3], square[3], straight[3];
            for (int j = 0; j < 3; ++j) {
                hx[j] = h[0] * t.x[j] + h[1] * t.y[j];
                hy[j] = h[1] * t.x[j] + h[2] * t.y[j];
                square[j] = hx[j] * t.x[j] + hy[j] * t.y[j];
                straight[j] = c[0] * t.x[j] + c[1] * t.y[j];
            }
            const Eight qx = t.x[0] + t.x[1] + t.x[2], qy = t.y[0] + t.y[1] + t.y[2],
                        hqx = hx[0] + hx[1] + hx[2], hqy = hy[0] + hy[1] + hy[2], whole = qx * hqx + qy * hqy,
                        squares = square[0] + square[1] + square[2],
                        lines = straight[0] + straight[1] + straight[2];
            const Eight hbx = t.a[0] * hx[0] + t.a[1] * hx[1] + t.a[2] * hx[2],
                        hby = t.a[0] * hy[0] + t.a[1] * hy[1] + t.a[2] * hy[2];
            const Eight share = t.area * fan.share;
            Eight value = {}, to[3][3], to_alpha[3];
            for (int j = 0; j < 3; ++j) {
                const Eight by_alpha = whole + 2 * (t.x[j] * hqx + t.y[j] * hqy) + squares + 2 * square[j] +
                                       5 * (lines + straight[j]) - 20 * influence.level;
                to_alpha[j] = share * by_alpha;
                value += t.a[j] * by_alpha;
                const Eight one = 2 * (t.sum + t.a[j]), two = 2 * (t.sum + 2 * t.a[j]),
                            five = 5 * (t.sum + t.a[j]);
                to[j][0] = share * (one * hqx + 2 * hbx + two * hx[j] + five * c[0]);
                to[j][1] = share * (one * hqy + 2 * hby + two * hy[j] + five * c[1]);
                to[j][2] = Eight{};
            }
            // By the triangle's area: its integral, linear in the opacities, is `value` times it.
            Eight of_n[3], of_u[3], of_v[3];
            Eight area = t.area;
            for (int lane = 0; lane < EIGHT; ++lane)
                area[lane] = area[lane] > 0 ? area[lane] : 1;  // its product is 0, too
            for (int j = 0; j < 3; ++j) of_n[j] = value * fan.share / area * t.n[j];
            cross(t.v, of_n, of_u);
            cross(of_n, t.u, of_v);
            for (int j = 0; j < 3; ++j) {
                to[0][j] -= of_u[j] + of_v[j];
                to[1][j] += of_u[j];
                to[2][j] += of_v[j];
            }
            for (int j = 0; j < 3; ++j) {
                const Eight along = to[j][2] * t.w[j], depth = fan.k * along * t.w[j];
                to_k += total(along);
                const int32_t *vertex = mesh_.faces + 3 * i + j;
                for (int lane = 0; lane < t.held; ++lane) {
                    Pulled &sum = pulled[-1 - place[vertex[3 * lane]]];
                    sum.x += to[j][0][lane];
                    sum.y += to[j][1][lane];
                    sum.z -= depth[lane];
                    sum.alpha += to_alpha[j][lane];
                }
            }
        }
        pulled[0].z += to_k * fan.k * plain_[pulled[0].vertex].w;  // k is in proportion to its depth
    }

    void add_position(int32_t v, double x, double y, double z, const MsVertexGradients &out) const {
        const double *m = projection_.m;
        for (int j = 0; j < 3; ++j)
            out.vertices[3 * (int64_t)v + j] += (float)(m[j] * x + m[4 + j] * y + m[8 + j] * z);
    }

    static double total(const Eight &lanes) {
        double a[EIGHT];
        std::memcpy(a, &lanes, sizeof a);
        return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
    }
    static void cross(const Eight a[3], const Eight b[3], Eight out[3]) {
        out[0] = a[1] * b[2] - a[2] * b[1];
        out[1] = a[2] * b[0] - a[0] * b[2];
        out[2] = a[0] * b[1] - a[1] * b[0];
    }
    // a b a of symmetric matrices.
    static void between(const double a[3], const double b[3], double out[3]) {
        const double p = a[0] * b[0] + a[1] * b[1], q = a[0] * b[1] + a[1] * b[2],
                     r = a[1] * b[0] + a[2] * b[1], t = a[1] * b[1] + a[2] * b[2];
        out[0] = p * a[0] + q * a[1];
        out[1] = p * a[1] + q * a[2];
        out[2] = r * a[1] + t * a[2];
    }

    const MsMesh mesh_;
    const Projection projection_;
    const double variance_;     // square samples
    const double depth_scale_;  // k for a fan at depth 1
    const Large<Projected> plain_;
    Large<Projected> moved_;
    Large<int32_t> owner_;         // fan that has the vertex
    std::vector<int32_t> starts_;  // fan g has the triangles [starts_[g], starts_[g + 1])
    Large<Fan> fans_;
};

}  // namespace ms
