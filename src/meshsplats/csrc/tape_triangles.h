// The triangles of one tile in the backward pass: their set-up, the moments of their fragments, and from
// these the gradients of their vertices.
//
// Values are v = (sum_k s_k v_k) / (sum_k s_k) with s = A p, p = (x, y, 1), A the inverse of the matrix V of
// the corners in homogeneous sample coordinates. As ds = -A dV s, a gradient g of v gives, summed over
// samples p at depth z = 1 / sum s,
//     dL/dv_k = A_k . sum z g p,  dL/dV = -A^T G A^T,  G_k = sum z g (v_k - v) p^T.
// So each triangle only needs the sums (moments) of z g and z g v times 1, x and y.
#pragma once

#include "scene.h"
#include "tile_area.h"
#include "vertex_gradients.h"

namespace ms {

class TapeTriangles {
  public:
    // Coordinates are relative to a per-triangle origin near the triangle and the tile, against cancellation.
    // Groups of four floats are written by store_transposed.
    struct Triangle {
        alignas(64) float a[4], b[4], c[4], low[4], high[4],
            first[4];                  // RGBA / depth; range and first corner of RGBA
        float qa, qb, qc, q_min;       // 1 / depth
        float q_max, x0, y0, padding;  // origin, relative to the tile
    };
    // sum[c]: sums of z g times 1, x and y, g the gradient of channel c of RGBA; last column: those of z g v,
    // over all channels c where v is the value relative to the first corner.
    struct Moments {
        alignas(64) float sum[4][4];
    };
    // A vertex attribute on a triangle: value / depth = a x + b y + c; range and first corner of the value.
    struct AttributePlane {
        float a, b, c, low, high, first;
    };

    // `channels`: of the attributes with gradients.
    TapeTriangles(const Scene &scene, int channels)
        : scene_(scene), mesh_(scene.mesh), attribute_channels_(channels), corner_attributes_(3 * channels) {
        // FanFilter::backward takes position gradients in camera space; all others are rotated to world
        // space.
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                rotation_[3 * i + j] =
                    scene.filtered ? (float)(i == j) : (float)scene.projection.m[4 * i + j];
    }

    // Triangle set-up for the faces of the tape, LANES at a time.
    void set_up(const TileArea &area, const int32_t *faces, size_t n) {
        area_ = area;
        count_ = n;
        const size_t batches = (n + LANES - 1) / LANES;
        if (corners_.size() < batches) {
            triangles_.resize(batches * LANES);
            moments_.resize(batches * LANES);
            corners_.resize(batches);
        }
        attribute_planes_.resize(n * attribute_channels_);
        attribute_moments_.assign(n * attribute_channels_ * 3, 0.0f);
        for (size_t i = 0; i < std::min(n, CORNERS_AHEAD); ++i) prefetch_corners(faces[i]);
        for (size_t begin = 0; begin < n; begin += LANES) set_up_batch(faces, n, begin);
    }

    const Triangle &operator[](uint32_t triangle) const { return triangles_[triangle]; }
    Moments &moments(uint32_t triangle) { return moments_[triangle]; }
    // By triangle and channel. Three moments: sums of x, y and 1 times the gradient.
    const AttributePlane &attribute(uint32_t triangle, int c) const {
        return attribute_planes_[(size_t)triangle * attribute_channels_ + c];
    }
    float *attribute_moments(uint32_t triangle, int c) {
        return &attribute_moments_[((size_t)triangle * attribute_channels_ + c) * 3];
    }
    // At the samples (x, y) relative to the triangle's origin, where the depth is z.
    Lanes attribute_value(uint32_t triangle, int c, const Lanes &x, const Lanes &y, const Lanes &z) const {
        const AttributePlane &p = attribute(triangle, c);
        return clamp(((broadcast(p.a) * x + broadcast(p.b) * y) + broadcast(p.c)) * z, broadcast(p.low),
                     broadcast(p.high));
    }

    // From the moments to the gradients of the vertices.
    void write_gradients(TileGradients &out) {
        // A fan of n triangles has about n vertices, other meshes more: then `out` grows.
        out.reserve(count_ + count_ / 2, attribute_channels_);
        for (size_t begin = 0; begin < count_; begin += LANES)
            write_batch(begin, (int)std::min<size_t>(LANES, count_ - begin), out);
    }

  private:
    // The corners of LANES triangles.
    struct Corners {
        Lanes s[3][3];             // by corner: a, b, c of s_k: the matrix A
        Lanes corner_delta[2][4];  // RGBA of the other corners relative to the first
        int32_t vertex[3][LANES];
    };

    static constexpr size_t FACES_AHEAD = 2 * LANES, CORNERS_AHEAD = LANES;  // prefetch distances

    __attribute__((always_inline)) void prefetch_corners(int64_t face) {
        for (int k = 0; k < 3; ++k) {
            const int64_t corner = mesh_.faces[3 * face + k];
            __builtin_prefetch(&scene_.vertices[corner]);
            __builtin_prefetch(mesh_.colors + 4 * corner);
        }
    }

    // Fills triangles_, corners_ and moments_ of the triangles [begin, begin + LANES).
    void set_up_batch(const int32_t *faces, size_t n, size_t begin) {
        const int size = (int)std::min<size_t>(LANES, n - begin);
        for (size_t i = begin; i < begin + size; ++i) {
            if (i + FACES_AHEAD < n) __builtin_prefetch(mesh_.faces + 3 * (int64_t)faces[i + FACES_AHEAD]);
            if (i + CORNERS_AHEAD < n) prefetch_corners(faces[i + CORNERS_AHEAD]);
        }
        TriangleSetup<LANES> &t = batch_;
        Corners &corners = corners_[begin / LANES];
        set_up_geometry(&faces[begin], size, corners.vertex);
        for (int i = 0; i < 3; ++i) {
            corners.s[i][0] = load_lanes(t.sa[i]);
            corners.s[i][1] = load_lanes(t.sb[i]);
            corners.s[i][2] = load_lanes(t.sc[i]);
        }
        Lanes rgba[3][4];
        for (int i = 0; i < 3; ++i)
            load_transposed([&](int k) { return t.rgba[i][k < size ? k : 0]; }, rgba[i]);
        for (int j = 0; j < 2; ++j)
            for (int c = 0; c < 4; ++c) corners.corner_delta[j][c] = rgba[j + 1][c] - rgba[0][c];
        store_triangles(corners, rgba, &triangles_[begin]);
        std::fill(&moments_[begin], &moments_[begin] + size, Moments{});
        for (int k = 0; k < size; ++k)
            for (int c = 0; c < attribute_channels_; ++c)
                attribute_planes_[(begin + k) * attribute_channels_ + c] = attribute_plane(corners, k, c);
    }

    // Writes LANES triangles from their corners and batch_.
    void store_triangles(const Corners &corners, const Lanes rgba[3][4], Triangle *first) {
        const TriangleSetup<LANES> &t = batch_;
        auto store_rgba = [&](const Lanes columns[4], float (Triangle::*row)[4]) {
            store_transposed(columns[0], columns[1], columns[2], columns[3],
                             [&](int k) { return first[k].*row; });
        };
        Lanes mixed[4];
        // Coefficient j of RGBA / depth.
        auto interpolate = [&](int j) {
            for (int c = 0; c < 4; ++c)
                mixed[c] = mul_add(corners.s[0][j], rgba[0][c],
                                   mul_add(corners.s[1][j], rgba[1][c], corners.s[2][j] * rgba[2][c]));
            return mixed;
        };
        store_rgba(interpolate(0), &Triangle::a);
        store_rgba(interpolate(1), &Triangle::b);
        store_rgba(interpolate(2), &Triangle::c);
        store_rgba(rgba[0], &Triangle::first);
        for (int c = 0; c < 4; ++c) mixed[c] = min_lanes(min_lanes(rgba[0][c], rgba[1][c]), rgba[2][c]);
        store_rgba(mixed, &Triangle::low);
        for (int c = 0; c < 4; ++c) mixed[c] = max_lanes(max_lanes(rgba[0][c], rgba[1][c]), rgba[2][c]);
        store_rgba(mixed, &Triangle::high);
        store_transposed(load_lanes(t.qa), load_lanes(t.qb), load_lanes(t.qc), load_lanes(t.q_min),
                         [&](int k) { return &first[k].qa; });
        store_transposed(load_lanes(t.q_max), load_lanes(origin_x_), load_lanes(origin_y_), broadcast(0),
                         [&](int k) { return &first[k].q_max; });
    }

    AttributePlane attribute_plane(const Corners &corners, int k, int channel) const {
        const TriangleSetup<LANES> &t = batch_;
        AttributePlane plane{0, 0, 0, 0, 0, 0};
        for (int i = 0; i < 3; ++i) {
            const float v = mesh_.attributes[(int64_t)corners.vertex[i][k] * attribute_channels_ + channel];
            plane.a += t.sa[i][k] * v;
            plane.b += t.sb[i][k] * v;
            plane.c += t.sc[i][k] * v;
            plane.low = i ? std::min(plane.low, v) : v;
            plane.high = i ? std::max(plane.high, v) : v;
            if (i == 0) plane.first = v;
        }
        return plane;
    }

    // Sets up batch_ for `size` faces, each relative to its own origin.
    void set_up_geometry(const int32_t *faces, int size, int32_t vertex[3][LANES]) {
        TriangleSetup<LANES> &t = batch_;
        for (int k = 0; k < size; ++k) {
            MS_ASSERT(faces[k] >= 0 && faces[k] < mesh_.face_count);
            t.face[k] = faces[k];
            const int32_t *corner = mesh_.faces + 3 * (int64_t)faces[k];
            for (int i = 0; i < 3; ++i) {
                const Projected &p = scene_.vertices[corner[i]];
                t.x[i][k] = p.x - area_.x0;
                t.y[i][k] = p.y - area_.y0;
                t.w[i][k] = p.w;
                t.rgba[i][k] = mesh_.colors + 4 * (int64_t)corner[i];
                vertex[i][k] = corner[i];
            }
        }
        choose_origins(t.x, size, origin_x_);
        choose_origins(t.y, size, origin_y_);
        t.set_up_visible();
        for (int k = 0; k < size; ++k) {
            if (!t.is_clipped(k)) continue;
            Vec3 v[3];
            scene_.homogeneous_corners(mesh_.faces + 3 * (int64_t)faces[k], area_.x0 + origin_x_[k],
                                       area_.y0 + origin_y_[k], v);
            t.set_up_clipped(k, v, scene_.projection.near);
        }
    }

    // Makes one coordinate of batch_ relative to the mean of the visible corners, clamped to the tile.
    // Rounded to an integer, so that the distances of samples from it are exact.
    void choose_origins(double p[3][LANES], int size, float *origin) {
        const TriangleSetup<LANES> &t = batch_;
        const double side = scene_.grid.largest_side;
        for (int k = 0; k < size; ++k) {
            double sum = 0, count = 0;
            for (int i = 0; i < 3; ++i) {
                sum += t.w[i][k] > 0 ? p[i][k] : 0;
                count += t.w[i][k] > 0 ? 1 : 0;
            }
            const double mean = sum / (count > 0 ? count : 1);
            origin[k] = (float)(int)(mean > 0 ? (mean < side ? mean : side) : 0);
            for (int i = 0; i < 3; ++i) p[i][k] -= origin[k];
        }
    }

    // The gradients of `size` triangles from `begin` on: dL/dv_k and dL/dV of the header.
    void write_batch(size_t begin, int size, TileGradients &out) {
        const Corners &corners = corners_[begin / LANES];
        const auto &s = corners.s;
        Lanes moments[4][4];
        for (int c = 0; c < 4; ++c)
            load_transposed([&](int i) { return moments_[begin + i].sum[c]; }, moments[c]);
        // Moments are in the order 1, x, y; from here on it is that of p: x, y, 1.
        Lanes of_rgba[4][3], g[3][3];
        for (int c = 0; c < 4; ++c)
            for (int j = 0; j < 3; ++j) of_rgba[c][j] = moments[c][(j + 1) % 3];
        // G, one row per corner, from v_k and v relative to the first corner.
        for (int j = 0; j < 3; ++j) {
            g[0][j] = broadcast(0) - moments[(j + 1) % 3][3];
            for (int k = 1; k < 3; ++k) {
                g[k][j] = g[0][j];
                for (int c = 0; c < 4; ++c)
                    g[k][j] = mul_add(corners.corner_delta[k - 1][c], of_rgba[c][j], g[k][j]);
            }
        }
        for (int c = 0; c < attribute_channels_; ++c) add_attribute(corners, begin, size, c, g);
        const Projection &pr = scene_.projection;
        alignas(64) float to_x[LANES], to_y[LANES];  // from the triangle's origin to the principal point
        for (int i = 0; i < LANES; ++i) {
            const Triangle &t = triangles_[begin + std::min(i, size - 1)];
            to_x[i] = (float)(pr.cx - area_.x0 - t.x0);
            to_y[i] = (float)(pr.cy - area_.y0 - t.y0);
        }
        TileGradients::Sum sums[3][LANES];
        for (int k = 0; k < 3; ++k) {
            store_transposed(dot(s[k], of_rgba[0]), dot(s[k], of_rgba[1]), dot(s[k], of_rgba[2]),
                             dot(s[k], of_rgba[3]), [&](int i) { return sums[k][i].rgba; });
            // Row k of dL/dV, then through the camera's focal lengths and principal point to camera space.
            Lanes d[3] = {broadcast(0), broadcast(0), broadcast(0)};
            for (int i = 0; i < 3; ++i) {
                const Lanes h = dot(g[i], s[k]);
                for (int j = 0; j < 3; ++j) d[j] = d[j] - s[i][j] * h;
            }
            const Lanes z = mul_add(load_lanes(to_x), d[0], mul_add(load_lanes(to_y), d[1], d[2]));
            const Lanes x = d[0] * broadcast((float)pr.fx), y = d[1] * broadcast((float)pr.fy);
            Lanes position[3];
            for (int j = 0; j < 3; ++j)
                position[j] =
                    mul_add(broadcast(rotation_[j]), x,
                            mul_add(broadcast(rotation_[3 + j]), y, broadcast(rotation_[6 + j]) * z));
            store_transposed(position[0], position[1], position[2], broadcast(0),
                             [&](int i) { return sums[k][i].position; });
        }
        out.reserve(3 * LANES, attribute_channels_);
        for (int i = 0; i < size; ++i)
            for (int k = 0; k < 3; ++k) add_corner(corners.vertex[k][i], sums[k][i], k, i, out);
    }

    // Sets the gradients of one attribute at the corners, and adds its part to G.
    void add_attribute(const Corners &corners, size_t begin, int size, int c, Lanes g[3][3]) {
        const int channels = attribute_channels_;
        Lanes sums[3];
        for (int j = 0; j < 3; ++j) {
            alignas(64) float column[LANES] = {};
            for (int i = 0; i < size; ++i)
                column[i] = attribute_moments_[((begin + i) * channels + c) * 3 + j];
            sums[j] = load_lanes(column);
        }
        for (int k = 0; k < 3; ++k) {
            corner_attributes_[k * channels + c] = dot(corners.s[k], sums);
            alignas(64) float delta[LANES] = {};
            for (int i = 0; i < size; ++i)
                delta[i] = mesh_.attributes[(int64_t)corners.vertex[k][i] * channels + c] -
                           attribute_planes_[(begin + i) * channels + c].first;
            for (int j = 0; j < 3; ++j) g[k][j] = mul_add(load_lanes(delta), sums[j], g[k][j]);
        }
    }

    // Adds the gradient of a corner to that of its vertex. The triangles of a fan follow each other, so a
    // small hash table without chaining finds most vertices again; others get another element.
    void add_corner(int32_t vertex, const TileGradients::Sum &sum, int corner, int lane, TileGradients &out) {
        MS_ASSERT(vertex >= 0 && vertex < mesh_.vertex_count && out.count < out.vertices.size());
        uint32_t &cached = cached_index_[(uint32_t)vertex % CACHE_SIZE];
        // Branch-free: hits are unpredictable. Uninitialised elements are masked to 0.
        const uint32_t candidate = cached < out.count ? cached : 0, end = (uint32_t)out.count;
        const bool hit = (cached < out.count) & (out.vertices[candidate] == vertex);
        const uint32_t index = cached = hit ? candidate : end;
        out.count += !hit;
        out.vertices[index] = vertex;
        TileGradients::Sum &to = out.sums[index];
        store4(to.position, masked4(hit, load4(to.position)) + load4(sum.position));
        store4(to.rgba, masked4(hit, load4(to.rgba)) + load4(sum.rgba));
        for (int c = 0; c < attribute_channels_; ++c) {
            float &attribute = out.attributes[(size_t)index * attribute_channels_ + c];
            attribute =
                (hit ? attribute : 0) + lane_of(corner_attributes_[corner * attribute_channels_ + c], lane);
        }
    }

    static Lanes dot(const Lanes a[3], const Lanes b[3]) {
        return mul_add(a[0], b[0], mul_add(a[1], b[1], a[2] * b[2]));
    }

    const Scene &scene_;
    const MsMesh &mesh_;
    const int attribute_channels_;
    float rotation_[9];  // 3 x 3, from the space of the position gradients to camera space

    // Of the tile.
    TileArea area_;
    size_t count_ = 0;  // triangles
    TriangleSetup<LANES> batch_;
    float origin_x_[LANES], origin_y_[LANES];       // of the triangles of batch_, relative to the tile
    std::vector<Triangle> triangles_;               // by index on the tape
    std::vector<Moments> moments_;                  // likewise
    std::vector<Corners> corners_;                  // of LANES triangles each
    std::vector<AttributePlane> attribute_planes_;  // (triangle, channel)
    std::vector<float> attribute_moments_;          // (triangle, channel, 3): x, y, 1
    std::vector<Lanes> corner_attributes_;          // (corner, channel) of LANES triangles

    static constexpr uint32_t CACHE_SIZE = 2048;
    uint32_t cached_index_[CACHE_SIZE] = {};  // by hash: where in TileGradients the vertex may be
};

}  // namespace ms
