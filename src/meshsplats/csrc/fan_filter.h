// Low-pass filter for fans: the screen-space widening that splat renderers apply to each covariance, for
// triangles.
//
// The triangles of one splat are a fan. Its opacity, linear within each triangle, is a density over the image
// with mean c and covariance M. A filter of variance s moves the projected vertices p to c + A (p - c) with
// A = (M + s I)^(1/2) M^(-1/2) = (I + s M^-1)^(1/2), so that the density has the covariance M + s I. Depths
// and opacities do not change.
//
// fan_moments.h finds c and M. A fan seen edge on has no width in one direction, where A would be unbounded:
// MIN_VARIANCE bounds it.
#pragma once

#include <algorithm>
#include <cmath>

#include "fan_moments.h"
#include "parallel.h"
#include "pooled_vector.h"

namespace ms {

class FanFilter {
  public:
    // Projects the vertices that faces use, and filters them. Fans without area and fans with a vertex nearer
    // than the near plane stay as they are. Keeps a pointer to the arrays of the mesh for backward(). Throws
    // SharedVertices.
    FanFilter(const MsMesh &mesh, const Projection &projection, int samples, int threads)
        : mesh_(mesh),
          projection_(projection),
          variance_(mesh.filter_px2 * samples * samples),
          depth_scale_(DEPTH_SHARE * std::sqrt(projection.fx * projection.fy)),
          fans_(mesh),
          filtered_(mesh.vertex_count) {
        MS_ASSERT(variance_ > 0);
        for_blocks(threads, [&](int32_t begin, int32_t end, Workspace &work) {
            project(begin, end, work);
            for (int32_t fan = begin; fan < end; ++fan) work.order.push_back(fan);
            for_batches(work, [&](const FanBatch &batch) {
                for (int lane = 0; lane < batch.size; ++lane) filter(batch, lane, work);
            });
        });
    }

    // (vertex_count,) in samples; undefined for vertices that no face uses.
    const Projected *filtered() const { return filtered_.data(); }

    // (fan_count + 1,) of fans in the order of the faces, and face_count.
    const std::vector<int32_t> &first_faces() const { return fans_.faces; }

    // Backward pass. Adds to `out` the gradients of positions in world space and of opacities. `grad` holds
    // those of the filtered vertices in camera space, (vertex_count, 3).
    void backward(const float *grad, const MsVertexGradients &out, int threads) const {
        for_blocks(threads, [&](int32_t begin, int32_t end, Workspace &work) {
            for (int32_t fan = begin; fan < end; ++fan)
                if (has_gradient(fan, grad)) work.order.push_back(fan);
            if (work.order.empty()) return;
            project(begin, end, work);
            work.gradients.resize(work.vertices.size());
            for_batches(work, [&](const FanBatch &batch) { backward_batch(batch, grad, work, out); });
        });
    }

  private:
    static constexpr double MIN_VARIANCE = 1e-4;  // added to M, as a share of the filter's variance
    static constexpr double DEPTH_SHARE = 0.1;  // of depth, scaled by k, in the extent parallel to the image
    static constexpr double OPACITY_BIAS = 1e-6;  // added to opacities: transparent fans need moments, too

    struct VertexGradient {
        double x, y;  // of the position in samples
        double z;     // of the camera depth
        double alpha;
    };
    // The memory in which a thread processes a block of consecutive fans: their vertices, from the slot
    // `base` on. Aligned, as its neighbours are of other threads.
    struct alignas(64) Workspace {
        int32_t base;
        PooledVector<FanVertex> vertices;
        PooledVector<VertexGradient> gradients;
        std::vector<int32_t> order;  // fans to process
    };
    // Gradients of the densities at q, relative to the mean: (q^T h q + c . q - level) inverse_mass.
    struct DensityGradient {
        vd h[3], c[2], level;
    };

    FanBlock block_of(const Workspace &work) const { return {mesh_, fans_, work.vertices.data(), work.base}; }

    // Calls body(begin, end, work) with an empty order for blocks of fans.
    template <class Body>
    void for_blocks(int threads, Body body) const {
        std::vector<Workspace> workspaces(threads);
        parallel_blocks(threads, fans_.fan_count(), 1 << 6, [&](int64_t begin, int64_t end, int thread) {
            workspaces[thread].order.clear();
            body((int32_t)begin, (int32_t)end, workspaces[thread]);
        });
    }

    void project(int32_t begin, int32_t end, Workspace &work) const {
        work.base = fans_.slots[begin];
        const size_t count = fans_.slots[end] - work.base;
        work.vertices.resize(count);
        const Projection projection = projection_;
        for (size_t i = 0; i < count; ++i) {
            const int64_t v = fans_.vertex(work.base + (int32_t)i);
            const Projected p = projection.project(projection.to_camera(mesh_.vertices + 3 * v));
            work.vertices[i] = {p.x, p.y, p.w, mesh_.colors[4 * v + 3] + OPACITY_BIAS};
        }
    }

    // Calls body(batch) for all fans of work.order, with their transforms. Fans are sorted by the number of
    // their triangles, as a batch takes as long as its largest fan.
    template <class Body>
    void for_batches(Workspace &work, Body body) const {
        const auto triangles = [&](int32_t fan) { return fans_.faces[fan + 1] - fans_.faces[fan]; };
        const int count = (int)work.order.size();
        for (int i = 1; i < count; ++i) {  // insertion sort: there are few, and most are in order
            const int32_t fan = work.order[i];
            int to = i;
            for (; to > 0 && triangles(work.order[to - 1]) > triangles(fan); --to)
                work.order[to] = work.order[to - 1];
            work.order[to] = fan;
        }
        FanBatch batch;
        for (int i = 0; i < count; i += WD) {
            batch.size = std::min(WD, count - i);
            batch.fewest = INT32_MAX, batch.most = 0;
            for (int lane = 0; lane < WD; ++lane) {
                const int32_t fan = work.order[i + std::min(lane, batch.size - 1)];
                batch.fan[lane] = fan;
                batch.first[lane] = fans_.faces[fan];
                batch.count[lane] = triangles(fan);
                batch.fewest = std::min(batch.fewest, batch.count[lane]);
                batch.most = std::max(batch.most, batch.count[lane]);
            }
            find_moments(block_of(work), depth_scale_, batch);
            solve_transforms(batch);
            body(batch);
        }
    }

    // a b a for symmetric 2 x 2 matrices xx, xy, yy.
    static void congruence(const vd a[3], const vd b[3], vd out[3]) {
        const vd p = a[0] * b[0] + a[1] * b[1], q = a[0] * b[1] + a[1] * b[2], r = a[1] * b[0] + a[2] * b[1],
                 t = a[1] * b[1] + a[2] * b[2];
        out[0] = p * a[0] + q * a[1];
        out[1] = p * a[1] + q * a[2];
        out[2] = r * a[1] + t * a[2];
    }

    // A of the fans of a batch, and which of them it moves.
    void solve_transforms(FanBatch &batch) const {
        // B = I + s M^-1. The square root of a 2 x 2 matrix B with determinant d^2 is
        // (B + d I) / sqrt(tr B + 2 d).
        const double s = variance_, least = MIN_VARIANCE * s;
        const vd mxx = batch.m[0] + least, mxy = batch.m[1], myy = batch.m[2] + least,
                 determinant = 1 / (mxx * myy - mxy * mxy);
        batch.inverse[0] = myy * determinant;
        batch.inverse[1] = -mxy * determinant;
        batch.inverse[2] = mxx * determinant;
        const vd bxx = 1 + s * batch.inverse[0], byy = 1 + s * batch.inverse[2],
                 d = root(1 + s * (batch.inverse[0] + batch.inverse[2]) + s * s * determinant),
                 scale = 1 / root(bxx + byy + 2 * d);
        batch.a[0] = (bxx + d) * scale;
        batch.a[1] = s * batch.inverse[1] * scale;
        batch.a[2] = (byy + d) * scale;
        constexpr double MAX_TRANSFORM = 1e30;
        for (int lane = 0; lane < WD; ++lane)
            batch.active[lane] =
                (batch.nearest[lane] > 0) & (batch.mass[lane] > 0) & (determinant[lane] > 0) &
                (batch.a[0][lane] + std::fabs(batch.a[1][lane]) + batch.a[2][lane] < MAX_TRANSFORM);
    }

    // Writes the filtered vertices of the fan in a lane.
    void filter(const FanBatch &batch, int lane, const Workspace &work) {
        const int32_t fan = batch.fan[lane], end = fans_.slots[fan + 1];
        double x0 = 0, y0 = 0, a[3] = {1, 0, 1};
        if (batch.active[lane]) {
            x0 = batch.x[lane], y0 = batch.y[lane];
            for (int i = 0; i < 3; ++i) a[i] = batch.a[i][lane];
        }
        for (int32_t slot = fans_.slots[fan]; slot < end; ++slot) {
            const FanVertex &p = work.vertices[slot - work.base];
            const double x = p.x - x0, y = p.y - y0;
            filtered_[fans_.vertex(slot)] = {x0 + (a[0] * x + a[1] * y), y0 + (a[1] * x + a[2] * y), p.w};
        }
    }

    bool has_gradient(int32_t fan, const float *grad) const {
        bool any = false;
        for (int32_t slot = fans_.slots[fan]; slot < fans_.slots[fan + 1]; ++slot) {
            const float *g = grad + 3 * (int64_t)fans_.vertex(slot);
            any |= (g[0] != 0) | (g[1] != 0) | (g[2] != 0);
        }
        return any;
    }

    void backward_batch(const FanBatch &batch, const float *grad, Workspace &work,
                        const MsVertexGradients &out) const {
        const DensityGradient density = backward_positions(batch, grad, work);
        backward_density(batch, density, work);
        for (int lane = 0; lane < batch.size; ++lane) {
            const int32_t fan = batch.fan[lane];
            for (int32_t slot = fans_.slots[fan]; slot < fans_.slots[fan + 1]; ++slot) {
                const int32_t v = fans_.vertex(slot), i = slot - work.base;
                if (!batch.active[lane]) {
                    const float *g = grad + 3 * (int64_t)v;
                    add_position(v, g[0], g[1], g[2], out);
                    continue;
                }
                const VertexGradient &g = work.gradients[i];
                const FanVertex &p = work.vertices[i];
                if (!(p.w > 0)) continue;  // of no face
                add_position(v, g.x * projection_.fx * p.w, g.y * projection_.fy * p.w,
                             g.z - (g.x * (p.x - projection_.cx) + g.y * (p.y - projection_.cy)) * p.w, out);
                out.colors[4 * (int64_t)v + 3] += (float)g.alpha;
            }
        }
    }

    // The gradients of the vertices for constant A and c. Returns the gradients of the densities through A
    // and c.
    DensityGradient backward_positions(const FanBatch &batch, const float *grad, Workspace &work) const {
        const double unit_x = 1 / projection_.fx, unit_y = 1 / projection_.fy;
        vd g[3] = {};  // gradient of A, symmetric
        DensityGradient density{};
        for (int lane = 0; lane < batch.size; ++lane) {
            if (!batch.active[lane]) continue;
            const double x0 = batch.x[lane], y0 = batch.y[lane],
                         a[3] = {batch.a[0][lane], batch.a[1][lane], batch.a[2][lane]};
            double sum[3] = {0, 0, 0}, c[2] = {0, 0};
            const int32_t fan = batch.fan[lane];
            for (int32_t slot = fans_.slots[fan]; slot < fans_.slots[fan + 1]; ++slot) {
                const int32_t v = fans_.vertex(slot), i = slot - work.base;
                const float *from = grad + 3 * (int64_t)v;
                VertexGradient &to = work.gradients[i];
                to = {0, 0, 0, 0};
                const FanVertex &p = work.vertices[i];
                if (!(p.w > 0)) continue;  // of no face
                const Projected &q = filtered_[v];
                const double z = 1 / p.w, x = from[0] * unit_x * z, y = from[1] * unit_y * z, dx = p.x - x0,
                             dy = p.y - y0;
                sum[0] += x * dx;
                sum[1] += 0.5 * (x * dy + y * dx);
                sum[2] += y * dy;
                to.x = a[0] * x + a[1] * y;
                to.y = a[1] * x + a[2] * y;
                to.z = from[2] + (x * (q.x - projection_.cx) + y * (q.y - projection_.cy)) * p.w;
                c[0] += x - to.x;
                c[1] += y - to.y;
            }
            for (int i = 0; i < 3; ++i) g[i][lane] = sum[i];
            for (int i = 0; i < 2; ++i) density.c[i][lane] = c[i];
        }
        // A A = I + s M^-1. The Sylvester equation A X + X A = g has the solution
        // X = (det A g + adj A g adj A) / (2 tr A det A), and h = -s M^-1 X M^-1.
        const vd *a = batch.a, det = a[0] * a[2] - a[1] * a[1], scale = 1 / (2 * (a[0] + a[2]) * det),
                 adjugate[3] = {a[2], -a[1], a[0]};
        vd x[3], product[3];
        congruence(adjugate, g, product);
        for (int i = 0; i < 3; ++i) x[i] = (det * g[i] + product[i]) * scale;
        congruence(batch.inverse, x, density.h);
        for (vd &h : density.h) h *= -variance_;
        density.level = density.h[0] * batch.m[0] + 2 * density.h[1] * batch.m[1] + density.h[2] * batch.m[2];
        return density;
    }

    // Adds the gradients through the densities, whose moments determine A and c: the derivatives of the
    // integrals at the top of fan_moments.h with respect to opacities, positions and areas.
    void backward_density(const FanBatch &batch, const DensityGradient &density, Workspace &work) const {
        const vd *h = density.h, *c = density.c;
        vd grad_k = {};
        int32_t origin[WD];
        const FanBlock block = block_of(work);
        FanTriangles t;
        for (int index = 0; index < batch.most; ++index) {
            t.load(block, batch, index, batch.x, batch.y);
            if (index == 0) std::copy(t.slot[0], t.slot[0] + WD, origin);
            vd hx[3], hy[3], quadratic[3], linear[3];  // h q_j, q_j^T h q_j, c . q_j
            for (int j = 0; j < 3; ++j) {
                hx[j] = h[0] * t.x[j] + h[1] * t.y[j];
                hy[j] = h[1] * t.x[j] + h[2] * t.y[j];
                quadratic[j] = hx[j] * t.x[j] + hy[j] * t.y[j];
                linear[j] = c[0] * t.x[j] + c[1] * t.y[j];
            }
            // Q, h Q, Q^T h Q, the sums of the above, h B.
            const vd qx = t.x[0] + t.x[1] + t.x[2], qy = t.y[0] + t.y[1] + t.y[2],
                     hqx = hx[0] + hx[1] + hx[2], hqy = hy[0] + hy[1] + hy[2], qhq = qx * hqx + qy * hqy,
                     quadratics = quadratic[0] + quadratic[1] + quadratic[2],
                     linears = linear[0] + linear[1] + linear[2];
            const vd hbx = t.a[0] * hx[0] + t.a[1] * hx[1] + t.a[2] * hx[2],
                     hby = t.a[0] * hy[0] + t.a[1] * hy[1] + t.a[2] * hy[2];
            const vd scale = t.area * batch.inverse_mass;
            vd integral = {}, grad[3][3],
               grad_alpha[3];  // integral: over the triangle, without the scale
            for (int j = 0; j < 3; ++j) {
                const vd by_alpha = qhq + 2 * (t.x[j] * hqx + t.y[j] * hqy) + quadratics + 2 * quadratic[j] +
                                    5 * (linears + linear[j]) - 20 * density.level;
                grad_alpha[j] = scale * by_alpha;
                integral += t.a[j] * by_alpha;
                const vd by_hq = 2 * (t.alpha_sum + t.a[j]), by_h = 2 * (t.alpha_sum + 2 * t.a[j]),
                         by_c = 5 * (t.alpha_sum + t.a[j]);
                grad[j][0] = scale * (by_hq * hqx + 2 * hbx + by_h * hx[j] + by_c * c[0]);
                grad[j][1] = scale * (by_hq * hqy + 2 * hby + by_h * hy[j] + by_c * c[1]);
                grad[j][2] = vd{};
            }
            add_area_gradient(t, integral * batch.inverse_mass, grad);
            for (int j = 0; j < 3; ++j) {
                const vd along = grad[j][2] * t.w[j], depth = batch.k * along * t.w[j];
                grad_k += along;  // 0 in the lanes of fans that have no such triangle, as their area is
                for (int lane = 0; lane < batch.size; ++lane) {
                    if (index >= batch.count[lane] || !batch.active[lane]) continue;
                    VertexGradient &sum = work.gradients[t.slot[j][lane]];
                    sum.x += grad[j][0][lane];
                    sum.y += grad[j][1][lane];
                    sum.z -= depth[lane];
                    sum.alpha += grad_alpha[j][lane];
                }
            }
        }
        for (int lane = 0; lane < batch.size; ++lane)  // k is proportional to the depth of the first vertex
            if (batch.active[lane])
                work.gradients[origin[lane]].z +=
                    grad_k[lane] * batch.k[lane] * work.vertices[origin[lane]].w;
    }

    // Adds the gradients of the corners through the areas of the triangles, whose gradients are `grad_area`.
    static void add_area_gradient(const FanTriangles &t, const vd &grad_area, vd grad[3][3]) {
        vd grad_n[3], grad_u[3], grad_v[3];
        vd scale = grad_area / t.area;
        for (int lane = 0; lane < WD; ++lane) scale[lane] = t.area[lane] > 0 ? scale[lane] : 0;
        for (int j = 0; j < 3; ++j) grad_n[j] = scale * t.n[j];
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

    const MsMesh mesh_;
    const Projection projection_;
    const double variance_;     // square samples
    const double depth_scale_;  // k of a fan at depth 1
    const FanVertices fans_;
    PooledVector<Projected> filtered_;
};

}  // namespace ms
