// Low-pass filter for fans: the screen-space widening that splat renderers apply to each covariance, for
// triangles.
//
// The triangles of one splat are a fan. Its opacity, linear within each triangle, is a density over the image
// with mean c and covariance M. A filter of variance s moves the projected vertices p to c + A (p - c) with
// A = (M + s I)^(1/2) M^(-1/2) = (I + s M^-1)^(1/2), so that the density has the covariance M + s I. Depths
// and opacities do not change.
//
// For a triangle of area T with opacities a_i at positions q_i, a = sum a_i, Q = sum q_i and B = sum a_i q_i,
// the integrals of opacity times 1, q and q q^T over the triangle are
//     T a / 3,  T / 12 (a Q + B),  T / 60 (a Q Q^T + B Q^T + Q B^T + sum (a + 2 a_i) q_i q_i^T).
//
// Two limits need care. A fan seen edge on has no width in one direction, where A would be unbounded:
// MIN_VARIANCE bounds it. Nor does it have an area in the image to weigh its triangles by: areas are those of
// triangles (x, y, k / z), where k scales depth to DEPTH_SHARE of its extent parallel to the image.
#pragma once

#include <atomic>
#include <cstring>
#include <stdexcept>

#include "parallel.h"
#include "pooled_vector.h"
#include "triangle.h"

namespace ms {

struct SharedVertices : std::runtime_error {
    SharedVertices() : std::runtime_error("two splats share a vertex") {}
};

class FanFilter {
  public:
    // Filters the projected vertices that faces use. Fans without area and fans with a vertex nearer than the
    // near plane stay as they are. Keeps a pointer to the arrays of the mesh for backward(). Throws
    // SharedVertices.
    FanFilter(const MsMesh &mesh, const Projection &projection, int samples,
              PooledVector<Projected> &&unfiltered, int threads)
        : mesh_(mesh),
          projection_(projection),
          variance_(mesh.filter_px2 * samples * samples),
          depth_scale_(DEPTH_SHARE * std::sqrt(projection.fx * projection.fy)),
          unfiltered_(std::move(unfiltered)),
          filtered_(mesh.vertex_count),
          owner_(mesh.vertex_count) {
        MS_ASSERT(mesh.face_splat && variance_ > 0);
        MS_ASSERT((int64_t)unfiltered_.size() == mesh.vertex_count);
        for (int64_t i = 0; i < mesh.face_count; ++i)
            if (i == 0 || mesh.face_splat[i] != mesh.face_splat[i - 1]) starts_.push_back((int32_t)i);
        fans_.resize(starts_.size());
        starts_.push_back((int32_t)mesh.face_count);
        // Each fan claims its vertices; a vertex of two fans keeps either claim, and the other fan notices.
        for_fan_blocks(threads, [&](int32_t begin, int32_t end, int) {
            for (int32_t fan = begin; fan < end; ++fan)
                for_each_corner(fan, [&](int32_t v) { __atomic_store_n(&owner_[v], fan, __ATOMIC_RELAXED); });
        });
        std::atomic<bool> shared{false};
        for_fan_blocks(threads, [&](int32_t begin, int32_t end, int) {
            // Separate loops: the steps of one solve_transform wait for each other, but not for other fans.
            for (int32_t fan = begin; fan < end; ++fan) accumulate_moments(fan);
            for (int32_t fan = begin; fan < end; ++fan) solve_transform(fans_[fan]);
            bool clash = false;
            for (int32_t fan = begin; fan < end; ++fan) clash |= !transform_vertices(fan);
            if (clash) shared = true;
        });
        if (shared) throw SharedVertices();
    }

    // (vertex_count,) in samples; undefined for vertices that no face uses.
    const Projected *filtered() const { return filtered_.data(); }

    // Backward pass. Adds to `out` the gradients of positions in world space and of opacities. `grad` holds
    // those of the filtered vertices in camera space, (vertex_count, 3).
    void backward(const float *grad, const MsVertexGradients &out, int threads) const {
        // owner_, but -1 - i for the vertices of the current fan, where i is the index in its list of
        // gradients.
        PooledVector<int32_t> index(owner_);
        std::vector<std::vector<FanVertexGradient>> buffers(threads);
        for_fan_blocks(threads, [&](int32_t begin, int32_t end, int thread) {
            for (int32_t fan = begin; fan < end; ++fan)
                backward_fan(fan, grad, index.data(), buffers[thread], out);
        });
    }

  private:
    static constexpr double MIN_VARIANCE = 1e-4;  // added to M, as a share of the filter's variance
    static constexpr double DEPTH_SHARE = 0.1;
    static constexpr double OPACITY_BIAS = 1e-6;  // added to opacities: transparent fans need moments, too

    struct Fan {
        // Until solve_transform, the first three are sums relative to the origin: see accumulate_moments.
        double inverse_mass;  // 1 / (60 integral of opacity over doubled areas)
        double x, y;          // mean c
        double m[3];          // covariance M: xx, xy, yy
        double x0, y0;        // origin of the sums: a vertex of the fan
        double k;             // scale of depths
        double a[3];          // A: xx, xy, yy
        bool active;          // false: the fan stays as it is
    };
    // Gradient of the fan's density at q, relative to the mean: (q^T h q + c . q - level) inverse_mass.
    struct DensityGradient {
        double h[3], c[2], level;
    };
    struct FanVertexGradient {
        int32_t vertex;
        double x, y;  // of the position in samples
        double z;     // of the camera depth
        double alpha;
    };
    // Triangles are processed eight at a time. Lanes are summed in a fixed order.
    typedef double Double8 __attribute__((vector_size(64)));
    static constexpr int BATCH = 8;
    struct Batch {
        Double8 x[3], y[3], w[3], a[3];  // corners: position relative to an origin, 1 / depth, opacity
        Double8 alpha_sum;               // over the corners
        Double8 u[3], v[3], n[3];        // edges 0 to 1 and 0 to 2 in (x, y, k / z), and their cross product
        Double8 area;                    // doubled: |n|
        int size;                        // lanes in use; corners are 0 in the others
        bool visible;                    // all corners are beyond the near plane
    };

    template <class Body>
    void for_fan_blocks(int threads, Body body) const {
        parallel_blocks(threads, (int64_t)fans_.size(), 1 << 10, [&](int64_t begin, int64_t end, int thread) {
            body((int32_t)begin, (int32_t)end, thread);
        });
    }
    // Calls body(vertex) at least once for each vertex of a fan. Repetitions are few if all triangles list
    // the centre first and continue along the rim.
    template <class Body>
    __attribute__((always_inline)) void for_each_corner(int32_t fan, Body body) const {
        int32_t head = -1, tail = -1;
        for (int64_t i = starts_[fan]; i < starts_[fan + 1]; ++i) {
            const int32_t *f = mesh_.faces + 3 * i;
            if (f[0] != head) body(f[0]);
            if (f[1] != tail) body(f[1]);
            body(f[2]);
            head = f[0], tail = f[2];
        }
    }

    // Loads up to BATCH triangles [first, end), relative to the origin (x0, y0).
    __attribute__((always_inline)) void load_batch(int64_t first, int64_t end, double x0, double y0, double k,
                                                   Batch &t) const {
        MS_ASSERT(first < end && end <= mesh_.face_count);
        t.visible = true;
        t.size = (int)std::min<int64_t>(BATCH, end - first);
        for (int j = 0; j < 3 && t.size < BATCH; ++j) t.x[j] = t.y[j] = t.w[j] = t.a[j] = Double8{};
        const int32_t *face = mesh_.faces + 3 * first;
        for (int lane = 0; lane < t.size; ++lane) {
            for (int j = 0; j < 3; ++j) {
                const int64_t v = *face++;
                const Projected &p = unfiltered_[v];
                t.x[j][lane] = p.x - x0;
                t.y[j][lane] = p.y - y0;
                t.w[j][lane] = p.w;
                t.a[j][lane] = mesh_.colors[4 * v + 3] + OPACITY_BIAS;
                t.visible &= p.w > 0;
            }
        }
        t.alpha_sum = t.a[0] + t.a[1] + t.a[2];
        t.u[0] = t.x[1] - t.x[0], t.u[1] = t.y[1] - t.y[0], t.u[2] = k * (t.w[1] - t.w[0]);
        t.v[0] = t.x[2] - t.x[0], t.v[1] = t.y[2] - t.y[0], t.v[2] = k * (t.w[2] - t.w[0]);
        cross(t.u, t.v, t.n);
        const Double8 square = t.n[0] * t.n[0] + t.n[1] * t.n[1] + t.n[2] * t.n[2];
        for (int lane = 0; lane < BATCH; ++lane) t.area[lane] = std::sqrt(square[lane]);
    }

    // The sums over the triangles of a fan, from which solve_transform finds its mean and covariance.
    void accumulate_moments(int32_t fan_index) {
        const int64_t first = starts_[fan_index], end = starts_[fan_index + 1];
        const Projected &origin = unfiltered_[mesh_.faces[3 * first]];
        Fan &fan = fans_[fan_index];
        fan.k = origin.w > 0 ? depth_scale_ / origin.w : 0;
        bool visible = true;
        Batch t;
        Double8 mass = {}, sx = {}, sy = {}, xx = {}, xy = {}, yy = {};
        for (int64_t i = first; i < end; i += BATCH) {
            load_batch(i, end, origin.x, origin.y, fan.k, t);
            visible &= t.visible;
            // Q = (x, y), B = (bx, by), and the sum of (a + 2 a_i) q_i q_i^T.
            const Double8 x = t.x[0] + t.x[1] + t.x[2], y = t.y[0] + t.y[1] + t.y[2];
            Double8 bx = {}, by = {}, txx = {}, txy = {}, tyy = {};
            for (int j = 0; j < 3; ++j) {
                const Double8 weight = t.alpha_sum + 2 * t.a[j];
                bx += t.a[j] * t.x[j];
                by += t.a[j] * t.y[j];
                txx += weight * t.x[j] * t.x[j];
                txy += weight * t.x[j] * t.y[j];
                tyy += weight * t.y[j] * t.y[j];
            }
            mass += 20 * t.alpha_sum * t.area;
            sx += 5 * t.area * (t.alpha_sum * x + bx);
            sy += 5 * t.area * (t.alpha_sum * y + by);
            xx += t.area * (txx + x * (t.alpha_sum * x + 2 * bx));
            xy += t.area * (txy + t.alpha_sum * x * y + bx * y + by * x);
            yy += t.area * (tyy + y * (t.alpha_sum * y + 2 * by));
        }
        fan.inverse_mass = total(mass);
        fan.x = total(sx);
        fan.y = total(sy);
        fan.m[0] = total(xx);
        fan.m[1] = total(xy);
        fan.m[2] = total(yy);
        fan.x0 = origin.x;
        fan.y0 = origin.y;
        fan.active = visible;
    }

    // Mean, covariance and A of a fan. The square root of a 2 x 2 matrix B with determinant d^2 is
    // (B + d I) / sqrt(tr B + 2 d).
    void solve_transform(Fan &fan) const {
        const bool has_mass = fan.inverse_mass > 0;
        fan.inverse_mass = 1 / fan.inverse_mass;
        const double x = fan.x * fan.inverse_mass, y = fan.y * fan.inverse_mass;
        fan.x = fan.x0 + x;
        fan.y = fan.y0 + y;
        fan.m[0] = fan.m[0] * fan.inverse_mass - x * x;
        fan.m[1] = fan.m[1] * fan.inverse_mass - x * y;
        fan.m[2] = fan.m[2] * fan.inverse_mass - y * y;
        const Inverse inverse = inverse_covariance(fan);
        // B = I + s M^-1.
        const double s = variance_, b[3] = {1 + s * inverse.m[0], s * inverse.m[1], 1 + s * inverse.m[2]},
                     d = std::sqrt(1 + s * (inverse.m[0] + inverse.m[2]) + s * s * inverse.determinant),
                     scale = 1 / std::sqrt(b[0] + b[2] + 2 * d);
        fan.a[0] = (b[0] + d) * scale;
        fan.a[1] = b[1] * scale;
        fan.a[2] = (b[2] + d) * scale;
        constexpr double MAX_TRANSFORM = 1e30;
        fan.active = fan.active & has_mass & (inverse.determinant > 0) &
                     (fan.a[0] + std::fabs(fan.a[1]) + fan.a[2] < MAX_TRANSFORM);
    }

    // Inverse of the covariance with MIN_VARIANCE added.
    struct Inverse {
        double m[3], determinant;  // xx, xy, yy
    };
    Inverse inverse_covariance(const Fan &fan) const {
        const double least = MIN_VARIANCE * variance_, xx = fan.m[0] + least, xy = fan.m[1],
                     yy = fan.m[2] + least, determinant = 1 / (xx * yy - xy * xy);
        return {{yy * determinant, -xy * determinant, xx * determinant}, determinant};
    }

    // Writes the filtered vertices of a fan; false if another fan owns one of them.
    bool transform_vertices(int32_t fan_index) {
        const Fan &fan = fans_[fan_index];
        bool owned = true;
        for_each_corner(fan_index, [&](int32_t v) {
            const Projected p = unfiltered_[v];
            if (owner_[v] != fan_index) {
                owned = false;
            } else if (!fan.active) {
                filtered_[v] = p;
            } else {
                const double x = p.x - fan.x, y = p.y - fan.y;
                filtered_[v] = {fan.x + (fan.a[0] * x + fan.a[1] * y), fan.y + (fan.a[1] * x + fan.a[2] * y),
                                p.w};
            }
        });
        return owned;
    }

    void backward_fan(int32_t fan_index, const float *grad, int32_t *index,
                      std::vector<FanVertexGradient> &buffer, const MsVertexGradients &out) const {
        const Fan &fan = fans_[fan_index];
        const size_t max_vertices = 3 * (size_t)(starts_[fan_index + 1] - starts_[fan_index]);
        if (buffer.size() < max_vertices) buffer.resize(max_vertices);
        FanVertexGradient *vertices = buffer.data();
        int count = 0;
        bool any = false;
        for_each_corner(fan_index, [&](int32_t v) {
            if (index[v] != fan_index) return;
            index[v] = -1 - count;
            vertices[count++].vertex = v;
            const float *g = grad + 3 * (int64_t)v;
            any |= (g[0] != 0) | (g[1] != 0) | (g[2] != 0);
        });
        if (!any) return;
        if (!fan.active) {
            for (int i = 0; i < count; ++i) {
                const float *g = grad + 3 * (int64_t)vertices[i].vertex;
                add_position(vertices[i].vertex, g[0], g[1], g[2], out);
            }
            return;
        }
        backward_density(fan_index, backward_positions(fan, grad, vertices, count), index, vertices);
        for (int i = 0; i < count; ++i) {
            const FanVertexGradient &g = vertices[i];
            const Projected &p = unfiltered_[g.vertex];
            add_position(g.vertex, g.x * projection_.fx * p.w, g.y * projection_.fy * p.w,
                         g.z - (g.x * (p.x - projection_.cx) + g.y * (p.y - projection_.cy)) * p.w, out);
            out.colors[4 * (int64_t)g.vertex + 3] += (float)g.alpha;
        }
    }

    // The gradients of the vertices for constant A and c. Returns the gradient of the density through A and
    // c.
    DensityGradient backward_positions(const Fan &fan, const float *grad, FanVertexGradient *vertices,
                                       int count) const {
        const double *a = fan.a, unit_x = 1 / projection_.fx, unit_y = 1 / projection_.fy;
        double g[3] = {0, 0, 0};  // gradient of A, symmetric
        DensityGradient density{};
        for (int i = 0; i < count; ++i) {
            FanVertexGradient &to = vertices[i];
            const Projected &p = unfiltered_[to.vertex], &q = filtered_[to.vertex];
            const float *t = grad + 3 * (int64_t)to.vertex;
            const double z = 1 / p.w, x = t[0] * unit_x * z, y = t[1] * unit_y * z, dx = p.x - fan.x,
                         dy = p.y - fan.y;
            g[0] += x * dx;
            g[1] += 0.5 * (x * dy + y * dx);
            g[2] += y * dy;
            to.x = a[0] * x + a[1] * y;
            to.y = a[1] * x + a[2] * y;
            to.z = t[2] + (x * (q.x - projection_.cx) + y * (q.y - projection_.cy)) * p.w;
            density.c[0] += x - to.x;
            density.c[1] += y - to.y;
            to.alpha = 0;
        }
        // A A = I + s M^-1. The Sylvester equation A X + X A = g has the solution
        // X = (det A g + adj A g adj A) / (2 tr A det A), and h = -s M^-1 X M^-1.
        const double det = a[0] * a[2] - a[1] * a[1], scale = 1 / (2 * (a[0] + a[2]) * det),
                     adjugate[3] = {a[2], -a[1], a[0]};
        double x[3], product[3];
        congruence(adjugate, g, product);
        for (int i = 0; i < 3; ++i) x[i] = (det * g[i] + product[i]) * scale;
        const Inverse inverse = inverse_covariance(fan);
        congruence(inverse.m, x, density.h);
        for (double &h : density.h) h *= -variance_;
        density.level = density.h[0] * fan.m[0] + 2 * density.h[1] * fan.m[1] + density.h[2] * fan.m[2];
        return density;
    }

    // Adds the gradients through the density, whose moments determine A and c: the derivatives of the
    // integrals in the header with respect to opacities, positions and areas.
    void backward_density(int32_t fan_index, const DensityGradient &density, const int32_t *index,
                          FanVertexGradient *vertices) const {
        const Fan &fan = fans_[fan_index];
        const double *h = density.h, *c = density.c;
        const int64_t first = starts_[fan_index], end = starts_[fan_index + 1];
        double grad_k = 0;
        Batch t;
        for (int64_t i = first; i < end; i += BATCH) {
            load_batch(i, end, fan.x, fan.y, fan.k, t);
            Double8 hx[3], hy[3], quadratic[3], linear[3];  // h q_j, q_j^T h q_j, c . q_j
            for (int j = 0; j < 3; ++j) {
                hx[j] = h[0] * t.x[j] + h[1] * t.y[j];
                hy[j] = h[1] * t.x[j] + h[2] * t.y[j];
                quadratic[j] = hx[j] * t.x[j] + hy[j] * t.y[j];
                linear[j] = c[0] * t.x[j] + c[1] * t.y[j];
            }
            // Q, h Q, Q^T h Q, the sums of the above, h B.
            const Double8 qx = t.x[0] + t.x[1] + t.x[2], qy = t.y[0] + t.y[1] + t.y[2],
                          hqx = hx[0] + hx[1] + hx[2], hqy = hy[0] + hy[1] + hy[2], qhq = qx * hqx + qy * hqy,
                          quadratics = quadratic[0] + quadratic[1] + quadratic[2],
                          linears = linear[0] + linear[1] + linear[2];
            const Double8 hbx = t.a[0] * hx[0] + t.a[1] * hx[1] + t.a[2] * hx[2],
                          hby = t.a[0] * hy[0] + t.a[1] * hy[1] + t.a[2] * hy[2];
            const Double8 scale = t.area * fan.inverse_mass;
            Double8 integral = {}, grad[3][3],
                    grad_alpha[3];  // integral: over the triangle, without the scale
            for (int j = 0; j < 3; ++j) {
                const Double8 by_alpha = qhq + 2 * (t.x[j] * hqx + t.y[j] * hqy) + quadratics +
                                         2 * quadratic[j] + 5 * (linears + linear[j]) - 20 * density.level;
                grad_alpha[j] = scale * by_alpha;
                integral += t.a[j] * by_alpha;
                const Double8 by_hq = 2 * (t.alpha_sum + t.a[j]), by_h = 2 * (t.alpha_sum + 2 * t.a[j]),
                              by_c = 5 * (t.alpha_sum + t.a[j]);
                grad[j][0] = scale * (by_hq * hqx + 2 * hbx + by_h * hx[j] + by_c * c[0]);
                grad[j][1] = scale * (by_hq * hqy + 2 * hby + by_h * hy[j] + by_c * c[1]);
                grad[j][2] = Double8{};
            }
            add_area_gradient(t, integral * fan.inverse_mass, grad);
            for (int j = 0; j < 3; ++j) {
                const Double8 along = grad[j][2] * t.w[j], depth = fan.k * along * t.w[j];
                grad_k += total(along);
                const int32_t *vertex = mesh_.faces + 3 * i + j;
                for (int lane = 0; lane < t.size; ++lane) {
                    MS_ASSERT(index[vertex[3 * lane]] < 0);
                    FanVertexGradient &sum = vertices[-1 - index[vertex[3 * lane]]];
                    sum.x += grad[j][0][lane];
                    sum.y += grad[j][1][lane];
                    sum.z -= depth[lane];
                    sum.alpha += grad_alpha[j][lane];
                }
            }
        }
        vertices[0].z +=
            grad_k * fan.k * unfiltered_[vertices[0].vertex].w;  // k is proportional to its depth
    }

    // Adds the gradients of the corners through the areas of the triangles, whose gradients are
    // `grad_area`.
    static void add_area_gradient(const Batch &t, const Double8 &grad_area, Double8 grad[3][3]) {
        Double8 grad_n[3], grad_u[3], grad_v[3];
        Double8 area = t.area;
        for (int lane = 0; lane < BATCH; ++lane) area[lane] = area[lane] > 0 ? area[lane] : 1;  // n is 0, too
        for (int j = 0; j < 3; ++j) grad_n[j] = grad_area / area * t.n[j];
        cross(t.v, grad_n, grad_u);
        cross(grad_n, t.u, grad_v);
        for (int j = 0; j < 3; ++j) {
            grad[0][j] -= grad_u[j] + grad_v[j];
            grad[1][j] += grad_u[j];
            grad[2][j] += grad_v[j];
        }
    }

    // Adds the gradient of a vertex, rotated from camera to world space.
    void add_position(int32_t v, double x, double y, double z, const MsVertexGradients &out) const {
        const double *m = projection_.m;
        for (int j = 0; j < 3; ++j)
            out.vertices[3 * (int64_t)v + j] += (float)(m[j] * x + m[4 + j] * y + m[8 + j] * z);
    }

    static double total(const Double8 &lanes) {
        double a[BATCH];
        std::memcpy(a, &lanes, sizeof a);
        return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
    }
    static void cross(const Double8 a[3], const Double8 b[3], Double8 out[3]) {
        out[0] = a[1] * b[2] - a[2] * b[1];
        out[1] = a[2] * b[0] - a[0] * b[2];
        out[2] = a[0] * b[1] - a[1] * b[0];
    }
    // a b a for symmetric 2 x 2 matrices xx, xy, yy.
    static void congruence(const double a[3], const double b[3], double out[3]) {
        const double p = a[0] * b[0] + a[1] * b[1], q = a[0] * b[1] + a[1] * b[2],
                     r = a[1] * b[0] + a[2] * b[1], t = a[1] * b[1] + a[2] * b[2];
        out[0] = p * a[0] + q * a[1];
        out[1] = p * a[1] + q * a[2];
        out[2] = r * a[1] + t * a[2];
    }

    const MsMesh mesh_;
    const Projection projection_;
    const double variance_;     // square samples
    const double depth_scale_;  // k of a fan at depth 1
    const PooledVector<Projected> unfiltered_;
    PooledVector<Projected> filtered_;
    PooledVector<int32_t> owner_;  // fan of each vertex
    std::vector<int32_t> starts_;  // fan i has the faces [starts_[i], starts_[i + 1])
    PooledVector<Fan> fans_;
};

}  // namespace ms
