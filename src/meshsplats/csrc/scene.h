// A mesh prepared for one camera: projected vertices, groups of triangles with bounds, depth groups.
#pragma once

#include <climits>
#include <memory>
#include <vector>

#include "fan_filter.h"
#include "grid.h"
#include "pooled_vector.h"
#include "triangle.h"

namespace ms {

// The plane that gives all triangles of a depth group their sort key.
struct DepthPlane {
    Linear q;            // 1 / depth, of the sample position in the image
    float q_min, q_max;  // range of 1 / depth over the corners of the group
};

// The column and row of a tile, packed for TileBox.
class TilePosition {
  public:
    TilePosition(int x, int y) : bits_(pack(x, HALF - x, y, HALF - y)) {
        MS_ASSERT(x >= 0 && x < (int)HALF && y >= 0 && y < (int)HALF);
    }

  private:
    friend class TileBox;
    static constexpr uint64_t HALF = 0x8000;
    static uint64_t pack(uint64_t a, uint64_t b, uint64_t c, uint64_t d) {
        return a | b << 16 | c << 32 | d << 48;
    }
    uint64_t bits_;
};

// The tiles that one triangle may touch, inclusive; empty where x0 > x1. One addition makes four comparisons:
// its 16-bit quarters reach HALF where x0 <= x, x <= x1, y0 <= y and y <= y1.
class TileBox {
  public:
    TileBox() = default;
    TileBox(int x0, int x1, int y0, int y1) : bits_(TilePosition::pack(HALF - x0, x1, HALF - y0, y1)) {
        MS_ASSERT(x0 >= 0 && x0 < (int)HALF && x1 >= 0 && x1 < (int)HALF);
        MS_ASSERT(y0 >= 0 && y0 < (int)HALF && y1 >= 0 && y1 < (int)HALF);
    }
    static TileBox empty() { return TileBox(1, 0, 1, 0); }
    bool contains(const TilePosition &tile) const { return ((bits_ + tile.bits_) & ALL) == ALL; }

  private:
    static constexpr uint64_t HALF = TilePosition::HALF, ALL = 0x8000800080008000;
    uint64_t bits_;
};

struct Scene {
    const MsMesh &mesh;
    const Grid &grid;
    Projection projection;
    const Projected *vertices;          // (vertex_count,), filtered if there is a filter
    std::unique_ptr<FanFilter> filter;  // if this scene made it
    bool filtered;
    std::vector<int32_t> group_start;  // group g: the triangles [group_start[g], group_start[g + 1])
    std::vector<DepthPlane> planes;    // by depth group
    PooledVector<TileBox> boxes;       // by triangle
    std::vector<float> splat_keys;     // by group, for the orders by the splat and of the list
    std::vector<BinItem> items;        // groups that may cover samples, nearest first

    // Rasterization needs items; replaying a tape does not. `known_filter` is the filter of an earlier scene
    // with the same mesh and camera, or null.
    Scene(const MsMesh &mesh, const MsCamera &camera, const Grid &grid, int threads, bool with_items = true,
          const FanFilter *known_filter = nullptr)
        : mesh(mesh), grid(grid), projection(camera, grid.samples), filtered(mesh.filter_px2 > 0) {
        MS_ASSERT(mesh.vertex_count >= 0 && mesh.face_count >= 0 && mesh.face_count <= INT32_MAX);
        MS_ASSERT((!filtered && mesh.by_splat != 1) || mesh.face_splat);
        MS_ASSERT(!filtered || mesh.by_splat != 2);
        if (filtered && !known_filter) {
            filter = std::make_unique<FanFilter>(mesh, projection, grid.samples, threads);
            known_filter = filter.get();
        } else if (!filtered) {
            projected_.resize(mesh.vertex_count);
            parallel_blocks(threads, mesh.vertex_count, 1 << 16, [&](int64_t begin, int64_t end, int) {
                for (int64_t i = begin; i < end; ++i)
                    projected_[i] = projection.project(projection.to_camera(mesh.vertices + 3 * i));
            });
        }
        vertices = known_filter ? known_filter->filtered() : projected_.data();
        if (!with_items) return;
        find_groups();
        if (mesh.by_splat)
            find_splat_keys(threads);
        else if (mesh.depth_group)
            find_depth_planes();
        find_items(threads);
    }

    // The corners of a face in camera space, with x and y in samples times depth, relative to the origin (x0,
    // y0): the input of TriangleSetup::set_up_clipped.
    void homogeneous_corners(const int32_t *face, double x0, double y0, Vec3 out[3]) const {
        for (int k = 0; k < 3; ++k) {
            const Projected &p = vertices[face[k]];
            if (filtered && p.w > 0) {
                out[k] = {(p.x - x0) / p.w, (p.y - y0) / p.w, 1 / p.w};
                continue;
            }
            Vec3 c = projection.to_camera(mesh.vertices + 3 * (int64_t)face[k]);
            out[k] = {projection.fx * c.x + (projection.cx - x0) * c.z,
                      projection.fy * c.y + (projection.cy - y0) * c.z, c.z};
        }
    }

  private:
    PooledVector<Projected> projected_;

    // Groups are the unit of binning and sorting: consecutive triangles of one splat, or of a strip. The
    // length limit is that of MeshTile, which keeps one bit per triangle of a group.
    void find_groups() {
        constexpr int MAX_FAN = 64, MAX_STRIP = 16;
        const int32_t *f = mesh.faces;
        group_start.reserve(mesh.face_count / 6 + 2);
        if (filter) {
            const std::vector<int32_t> &fans = filter->first_faces();
            for (size_t fan = 0; fan + 1 < fans.size(); ++fan)
                for (int64_t i = fans[fan]; i < fans[fan + 1]; i += MAX_FAN)
                    group_start.push_back((int32_t)i);
            group_start.push_back((int32_t)mesh.face_count);
            return;
        }
        for (int64_t i = 0; i < mesh.face_count; ++i, f += 3) {
            for (int k = 0; k < 3; ++k) MS_ASSERT(f[k] >= 0 && f[k] < mesh.vertex_count);
            bool joins = false;
            if (i > 0) {
                int64_t length = i - group_start.back();
                if (mesh.face_splat) {
                    joins = length < MAX_FAN && mesh.face_splat[i] == mesh.face_splat[i - 1];
                } else if (length < MAX_STRIP) {
                    const int32_t *g = f - 3;
                    for (int k = 0; k < 3; ++k) joins |= f[k] == g[0] || f[k] == g[1] || f[k] == g[2];
                }
            }
            if (!joins) group_start.push_back((int32_t)i);
        }
        group_start.push_back((int32_t)mesh.face_count);
    }

    // The key of all groups of a splat: minus the depth of its centre, the mean of the corners of its
    // triangles; of a list, the number of each group.
    void find_splat_keys(int threads) {
        const int64_t groups = (int64_t)group_start.size() - 1;
        splat_keys.resize(groups);
        if (mesh.by_splat == 2) {  // rounding keeps ties, of which the later group is in front
            for (int64_t g = 0; g < groups; ++g) splat_keys[g] = (float)g;
            return;
        }
        auto splat = [&](int64_t group) { return mesh.face_splat[group_start[group]]; };
        parallel_blocks(threads, groups, 1 << 12, [&](int64_t begin, int64_t end, int) {
            for (int64_t g = begin; g < end; ++g) {
                if (g > 0 && splat(g) == splat(g - 1)) continue;  // of a splat that began before
                int64_t last = g;
                while (last + 1 < groups && splat(last + 1) == splat(g)) ++last;
                const float key = splat_key(group_start[g], group_start[last + 1]);
                std::fill(&splat_keys[g], &splat_keys[last] + 1, key);
            }
        });
    }

    float splat_key(int64_t first_face, int64_t end_face) const {
        double sum[3] = {0, 0, 0};
        for (const int32_t *corner = mesh.faces + 3 * first_face; corner < mesh.faces + 3 * end_face;
             ++corner)
            for (int i = 0; i < 3; ++i) sum[i] += mesh.vertices[3 * (int64_t)*corner + i];
        const double corners = 3 * (double)(end_face - first_face);
        return -(float)projection.depth(sum[0] / corners, sum[1] / corners, sum[2] / corners);
    }

    // The plane of a depth group is that of its largest triangle in world space.
    void find_depth_planes() {
        struct Largest {
            double area = -1;
            int64_t face = -1;
        };
        std::vector<Largest> largest;
        for (int64_t i = 0; i < mesh.face_count; ++i) {
            int32_t g = mesh.depth_group[i];
            MS_ASSERT(g >= -1 && g < mesh.face_count);
            if (g < 0) continue;
            if ((size_t)g >= largest.size()) {
                largest.resize(g + 1);
                planes.resize(g + 1, {{0, 0, 0}, std::numeric_limits<float>::max(), 0});
            }
            const int32_t *f = mesh.faces + 3 * i;
            double e[2][3];
            for (int k = 0; k < 3; ++k) {
                double origin = mesh.vertices[3 * (int64_t)f[0] + k];
                e[0][k] = mesh.vertices[3 * (int64_t)f[1] + k] - origin;
                e[1][k] = mesh.vertices[3 * (int64_t)f[2] + k] - origin;
                // Corners nearer than the near plane count as on it.
                double w = vertices[f[k]].w;
                float q = (float)(w > 0 ? w : 1 / projection.near);
                planes[g].q_min = std::min(planes[g].q_min, q);
                planes[g].q_max = std::max(planes[g].q_max, q);
            }
            double nx = e[0][1] * e[1][2] - e[0][2] * e[1][1], ny = e[0][2] * e[1][0] - e[0][0] * e[1][2],
                   nz = e[0][0] * e[1][1] - e[0][1] * e[1][0];
            double area = nx * nx + ny * ny + nz * nz;
            if (area > largest[g].area) largest[g] = {area, i};
        }
        for (size_t g = 0; g < planes.size(); ++g) {
            if (largest[g].face < 0) continue;
            Vec3 v[3];
            homogeneous_corners(mesh.faces + 3 * largest[g].face, 0, 0, v);
            planes[g].q = inverse_depth(v, {0, 0, planes[g].q_max});
        }
    }

    // 1 / depth in the plane through the homogeneous corners v; `edge_on` for a plane that is seen edge on
    // and has no single depth per sample.
    static Linear inverse_depth(const Vec3 v[3], const Linear &edge_on) {
        double det = determinant(v);
        Linear q{0, 0, 0};
        for (int i = 0; i < 3; ++i) {
            const Vec3 &c = v[(i + 1) % 3], &d = v[(i + 2) % 3];
            q.a += c.y * d.z - d.y * c.z;
            q.b += d.x * c.z - c.x * d.z;
            q.c += c.x * d.y - d.x * c.y;
        }
        q = {q.a / det, q.b / det, q.c / det};
        return std::isfinite(q.a) && std::isfinite(q.b) && std::isfinite(q.c) ? q : edge_on;
    }

    void find_items(int threads) {
        int64_t groups = (int64_t)group_start.size() - 1;
        constexpr int64_t block = 1 << 14;
        boxes.resize(mesh.face_count);
        std::vector<std::vector<BinItem>> parts((groups + block - 1) / block);
        parallel_blocks(threads, groups, block, [&](int64_t begin, int64_t end, int) {
            auto &part = parts[begin / block];
            BinItem item;
            for (int64_t g = begin; g < end; ++g)
                if (bound_group(g, item)) part.push_back(item);
        });
        size_t total = 0;
        for (auto &part : parts) total += part.size();
        items.reserve(total);
        for (auto &part : parts) {
            items.insert(items.end(), part.begin(), part.end());
            std::vector<BinItem>().swap(part);
        }
        // Of equal depths, the splat that comes later is in front, as where triangles are painted in order.
        if (mesh.by_splat) std::reverse(items.begin(), items.end());
        sort_items(items);
    }

    // The box of the visible part of a triangle in the image, in samples, and its nearest point.
    struct Bounds {
        double low[2], high[2];
        double nearest = 0;  // 1 / depth; 0: nothing is visible

        void include(double x, double y) {
            low[0] = std::min(low[0], x);
            high[0] = std::max(high[0], x);
            low[1] = std::min(low[1], y);
            high[1] = std::max(high[1], y);
        }
    };

    Bounds bound_triangle(const int32_t *face) const {
        constexpr double inf = std::numeric_limits<double>::infinity();
        Bounds bounds{{inf, inf}, {-inf, -inf}};
        const Projected *p[3] = {&vertices[face[0]], &vertices[face[1]], &vertices[face[2]]};
        int visible = (p[0]->w > 0) + (p[1]->w > 0) + (p[2]->w > 0);
        if (visible == 0) return bounds;
        for (int k = 0; k < 3; ++k) {
            if (p[k]->w > 0) {
                bounds.include(p[k]->x, p[k]->y);
                bounds.nearest = std::max(bounds.nearest, p[k]->w);
            }
        }
        if (visible < 3) {
            // Near-plane clipping: the intersections of the edges with the near plane.
            Vec3 v[3];
            homogeneous_corners(face, 0, 0, v);
            for (int k = 0; k < 3; ++k) {
                const Vec3 &a = v[k], &b = v[(k + 1) % 3];
                if ((p[k]->w > 0) == (p[(k + 1) % 3]->w > 0)) continue;
                // Both shares on their own: differences of a corner far away and a near one lose the latter.
                double of_a = (b.z - projection.near) / (b.z - a.z);
                double of_b = (projection.near - a.z) / (b.z - a.z);
                bounds.include((of_a * a.x + of_b * b.x) / projection.near,
                               (of_a * a.y + of_b * b.y) / projection.near);
            }
            bounds.nearest = 1 / projection.near;
        }
        return bounds;
    }

    // Fills the boxes of the triangles of a group, and its item; false if it covers no sample centre. The key
    // is that of the splat, or the largest 1 / depth in the group, so that no fragment of it is nearer.
    bool bound_group(int64_t group, BinItem &item) {
        double key = 0;
        int left = INT_MAX, right = -1, top = INT_MAX, bottom = -1;
        for (int64_t i = group_start[group]; i < group_start[group + 1]; ++i) {
            boxes[i] = TileBox::empty();
            Bounds bounds = bound_triangle(mesh.faces + 3 * i);
            if (bounds.nearest == 0) continue;
            int x0, x1, y0, y1;
            if (!sample_range(bounds.low[0], bounds.high[0], grid.width, x0, x1) ||
                !sample_range(bounds.low[1], bounds.high[1], grid.height, y0, y1))
                continue;
            x0 = grid.tile_of(x0), x1 = grid.tile_of(x1), y0 = grid.tile_of(y0), y1 = grid.tile_of(y1);
            boxes[i] = TileBox(x0, x1, y0, y1);
            left = std::min(left, x0), right = std::max(right, x1);
            top = std::min(top, y0), bottom = std::max(bottom, y1);
            if (!planes.empty() && mesh.depth_group[i] >= 0)
                bounds.nearest = std::max(bounds.nearest, (double)planes[mesh.depth_group[i]].q_max);
            key = std::max(key, bounds.nearest);
        }
        if (left > right) return false;
        if (mesh.by_splat) key = splat_keys[group];
        item = {{(float)key, group_start[group], group_start[group + 1] - group_start[group]},
                (uint16_t)left,
                (uint16_t)right,
                (uint16_t)top,
                (uint16_t)bottom};
        return true;
    }
};

}  // namespace ms
