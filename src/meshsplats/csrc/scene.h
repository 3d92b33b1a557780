// A mesh made ready for one camera: projected vertices, groups of triangles, depth groups.
#pragma once

#include <climits>
#include <memory>
#include <vector>

#include "fan_filter.h"
#include "grid.h"
#include "large.h"
#include "triangle.h"

namespace ms {

// The common 1 / depth plane of coplanar layers.
struct DepthPlane {
    Linear q;  // of the sample position
    float q_min, q_max;
};

// A tile's column and row (below 2^15) in a form that TileBox understands.
class TileNumber {
  public:
    TileNumber(int x, int y) : bits_(four(x, HALF - x, y, HALF - y)) {}

  private:
    friend class TileBox;
    static constexpr uint64_t HALF = 0x8000;
    static uint64_t four(uint64_t a, uint64_t b, uint64_t c, uint64_t d) {
        return a | b << 16 | c << 32 | d << 48;
    }
    uint64_t bits_;
};

// The tiles that one triangle may touch, inclusive; none where x0 > x1. Four comparisons are one addition:
// each of its quarters reaches HALF where x0 <= x, x <= x1, y0 <= y and y <= y1.
class TileBox {
  public:
    TileBox() = default;
    TileBox(int x0, int x1, int y0, int y1) : bits_(TileNumber::four(HALF - x0, x1, HALF - y0, y1)) {}
    bool has(const TileNumber &tile) const { return ((bits_ + tile.bits_) & ALL) == ALL; }

  private:
    static constexpr uint64_t HALF = TileNumber::HALF, ALL = 0x8000800080008000;
    uint64_t bits_;
};

struct Scene {
    const MsMesh &mesh;
    const Grid &grid;
    Projection projection;
    const Projected *vertices;
    std::unique_ptr<FanFilter> filter;  // if it was made for this scene
    bool filtered;
    std::vector<int32_t> group_start;  // triangles [group_start[g], group_start[g + 1]) are one group
    std::vector<DepthPlane> planes;    // by depth group
    Large<TileBox> boxes;              // by triangle
    std::vector<Item> items;           // groups that may cover samples, nearest first

    // Items are needed to draw; without, just to follow a log. `known` is the filter of the same picture.
    Scene(const MsMesh &mesh, const MsCamera &camera, const Grid &grid, int threads, bool with_items = true,
          const FanFilter *known = nullptr)
        : mesh(mesh), grid(grid), projection(camera, grid.samples), filtered(mesh.filter_px2 > 0) {
        if (!known) {
            projected_.resize(mesh.vertex_count);
            parallel_blocks(threads, mesh.vertex_count, 1 << 16, [&](int64_t a, int64_t b, int) {
                for (int64_t i = a; i < b; ++i)
                    projected_[i] = projection.project(projection.to_camera(mesh.vertices + 3 * i));
            });
            if (filtered) {
                filter = std::make_unique<FanFilter>(mesh, projection, grid.samples, std::move(projected_),
                                                     threads);
                known = filter.get();
            }
        }
        vertices = known ? known->moved() : projected_.data();
        if (!with_items) return;
        find_groups();
        if (mesh.depth_group) find_planes();
        find_items(threads);
    }

    // The corners of a triangle in camera space, x and y in samples times depth (see triangle.h), moved by
    // (x0, y0).
    void homogeneous(const int32_t *face, double x0, double y0, Vec3 out[3]) const {
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
    Large<Projected> projected_;

    // Triangles are binned and sorted by the group: a run that belongs to one splat or hangs together.
    void find_groups() {
        constexpr int longest = 64, longest_strip = 16;
        const int32_t *f = mesh.faces;
        group_start.reserve(mesh.face_count / 6 + 2);
        for (int64_t i = 0; i < mesh.face_count; ++i, f += 3) {
            bool joins = false;
            if (i > 0) {
                int64_t length = i - group_start.back();
                if (mesh.face_splat) {
                    joins = length < longest && mesh.face_splat[i] == mesh.face_splat[i - 1];
                } else if (length < longest_strip) {
                    const int32_t *g = f - 3;
                    for (int k = 0; k < 3; ++k) joins |= f[k] == g[0] || f[k] == g[1] || f[k] == g[2];
                }
            }
            if (!joins) group_start.push_back((int32_t)i);
        }
        group_start.push_back((int32_t)mesh.face_count);
    }

    void find_planes() {
        struct Largest {
            double area = -1;
            int64_t face = -1;
        };
        std::vector<Largest> largest;
        for (int64_t i = 0; i < mesh.face_count; ++i) {
            int32_t g = mesh.depth_group[i];
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
            homogeneous(mesh.faces + 3 * largest[g].face, 0, 0, v);
            double det = v[0].x * (v[1].y * v[2].z - v[2].y * v[1].z) -
                         v[0].y * (v[1].x * v[2].z - v[2].x * v[1].z) +
                         v[0].z * (v[1].x * v[2].y - v[2].x * v[1].y);
            Linear q{0, 0, 0};
            for (int i = 0; i < 3; ++i) {
                const Vec3 &c = v[(i + 1) % 3], &d = v[(i + 2) % 3];
                q.a += c.y * d.z - d.y * c.z;
                q.b += d.x * c.z - c.x * d.z;
                q.c += c.x * d.y - d.x * c.y;
            }
            q = {q.a / det, q.b / det, q.c / det};
            // A plane seen edge on has no depth of its own on the picture: its nearest point stands for it.
            if (!std::isfinite(q.a) || !std::isfinite(q.b) || !std::isfinite(q.c))
                q = {0, 0, planes[g].q_max};
            planes[g].q = q;
        }
    }

    void find_items(int threads) {
        int64_t groups = (int64_t)group_start.size() - 1;
        constexpr int64_t block = 1 << 14;
        boxes.resize(mesh.face_count);
        std::vector<std::vector<Item>> parts((groups + block - 1) / block);
        parallel_blocks(threads, groups, block, [&](int64_t a, int64_t b, int) {
            auto &part = parts[a / block];
            Item item;
            for (int64_t g = a; g < b; ++g)
                if (bound(g, item)) part.push_back(item);
        });
        size_t total = 0;
        for (auto &part : parts) total += part.size();
        items.reserve(total);
        for (auto &part : parts) {
            items.insert(items.end(), part.begin(), part.end());
            std::vector<Item>().swap(part);
        }
        sort_items(items);
    }

    // The tiles of a group and of each of its triangles, and its nearest point; false if it covers no sample
    // centre.
    bool bound(int64_t group, Item &item) {
        constexpr double inf = std::numeric_limits<double>::infinity();
        double key = 0;
        int left = INT_MAX, right = -1, top = INT_MAX, bottom = -1;
        for (int64_t i = group_start[group]; i < group_start[group + 1]; ++i) {
            boxes[i] = TileBox(1, 0, 1, 0);
            double lo[2] = {inf, inf}, hi[2] = {-inf, -inf};
            auto include = [&](double x, double y) {
                lo[0] = std::min(lo[0], x);
                hi[0] = std::max(hi[0], x);
                lo[1] = std::min(lo[1], y);
                hi[1] = std::max(hi[1], y);
            };
            const int32_t *f = mesh.faces + 3 * i;
            const Projected *p[3] = {&vertices[f[0]], &vertices[f[1]], &vertices[f[2]]};
            int in_front = (p[0]->w > 0) + (p[1]->w > 0) + (p[2]->w > 0);
            if (in_front == 0) continue;
            double nearest = 0;
            for (int k = 0; k < 3; ++k) {
                if (p[k]->w > 0) {
                    include(p[k]->x, p[k]->y);
                    nearest = std::max(nearest, p[k]->w);
                }
            }
            if (in_front < 3) {
                // Where the edges cross the near plane.
                Vec3 v[3];
                homogeneous(f, 0, 0, v);
                for (int k = 0; k < 3; ++k) {
                    const Vec3 &a = v[k], &b = v[(k + 1) % 3];
                    if ((p[k]->w > 0) == (p[(k + 1) % 3]->w > 0)) continue;
                    double t = (projection.near - a.z) / (b.z - a.z);
                    include((a.x + t * (b.x - a.x)) / projection.near,
                            (a.y + t * (b.y - a.y)) / projection.near);
                }
                nearest = 1 / projection.near;
            }
            int x0, x1, y0, y1;
            if (!sample_range(lo[0], hi[0], grid.width, x0, x1) ||
                !sample_range(lo[1], hi[1], grid.height, y0, y1))
                continue;
            x0 = grid.tile_of(x0), x1 = grid.tile_of(x1), y0 = grid.tile_of(y0), y1 = grid.tile_of(y1);
            boxes[i] = TileBox(x0, x1, y0, y1);
            left = std::min(left, x0), right = std::max(right, x1);
            top = std::min(top, y0), bottom = std::max(bottom, y1);
            if (mesh.depth_group && mesh.depth_group[i] >= 0)
                nearest = std::max(nearest, (double)planes[mesh.depth_group[i]].q_max);
            key = std::max(key, nearest);
        }
        if (left > right) return false;
        item = {{(float)key, group_start[group], group_start[group + 1] - group_start[group]},
                (uint16_t)left,
                (uint16_t)right,
                (uint16_t)top,
                (uint16_t)bottom};
        return true;
    }
};

}  // namespace ms
