// Gaussian splats as a camera sees them: projected, coloured, and in the order of their centres' depths.
//
// EWA splatting (Zwicker et al. 2001) with the conventions of 3D Gaussian Splatting (Kerbl et al. 2023): the
// projected covariance is dilated, and alpha below 1/255 is skipped. The kernel 'antialiased' compensates
// opacity for the dilation (Yu et al. 2024); '2dgs' intersects rays with the planes of flat splats (Huang et
// al. 2024). splat_tile.h blends them.
#pragma once

#include <memory>

#include "splat_stages.h"

namespace ms {

constexpr float MIN_ALPHA = 1.0f / 255;

enum Kernel { KERNEL_3DGS = 0, KERNEL_ANTIALIASED = 1, KERNEL_2DGS = 2 };

struct ProjectedSplat {
    double x, y;  // projected centre, samples
    // At (dx, dy) from the centre, the squared Mahalanobis distance is (m[0] dx + m[1] dy)^2 + (m[2] dy)^2.
    // The usual quadratic form cancels for thin splats; a sum of squares does not. Not used by 2dgs.
    double m[3];
    float low, high;  // range of rows, samples
    float opacity;
    float rgb[3];
};

// For 2dgs. The ray through the projected centre plus (dx, dy) meets the splat's plane at
// u = m[0] . (dx, dy, 1) / m[2] . (dx, dy, 1) standard deviations along the first axis, v with m[1] along the
// second axis, and at depth w . (u, v, 1).
struct ProjectedPlane {
    double m[3][3];
    float w[3];
};

// Display colour along the unit direction d from the camera: 1/2 + sum of coefficients times real spherical
// harmonics, at least 0. Of degree 0 alone it is also limited to 1, as a vertex colour is. `used` is 1, 4, 9
// or 16.
inline void sh_color(const float *sh, int used, const double d[3], float rgb[3]) {
    MS_ASSERT(used == 1 || used == 4 || used == 9 || used == 16);
    double x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    double basis[16];
    const double pi = 3.14159265358979323846;
    basis[0] = 0.5 * std::sqrt(1 / pi);
    if (used > 1) {
        double c = std::sqrt(3 / (4 * pi));
        basis[1] = -c * y;
        basis[2] = c * z;
        basis[3] = -c * x;
    }
    if (used > 4) {
        double c = 0.5 * std::sqrt(15 / pi);
        basis[4] = c * x * y;
        basis[5] = -c * y * z;
        basis[6] = 0.25 * std::sqrt(5 / pi) * (2 * zz - xx - yy);
        basis[7] = -c * x * z;
        basis[8] = 0.5 * c * (xx - yy);
    }
    if (used > 9) {
        double c3 = 0.25 * std::sqrt(35 / (2 * pi)), c2 = 0.5 * std::sqrt(105 / pi),
               c1 = 0.25 * std::sqrt(21 / (2 * pi));
        basis[9] = -c3 * y * (3 * xx - yy);
        basis[10] = c2 * x * y * z;
        basis[11] = -c1 * y * (4 * zz - xx - yy);
        basis[12] = 0.25 * std::sqrt(7 / pi) * z * (2 * zz - 3 * xx - 3 * yy);
        basis[13] = -c1 * x * (4 * zz - xx - yy);
        basis[14] = 0.5 * c2 * z * (xx - yy);
        basis[15] = -c3 * x * (xx - 3 * yy);
    }
    for (int channel = 0; channel < 3; ++channel) {
        double sum = 0.5;
        for (int i = 0; i < used; ++i) sum += basis[i] * sh[3 * i + channel];
        rgb[channel] = (float)std::max(0.0, used == 1 ? std::min(1.0, sum) : sum);
    }
}

class SplatScene {
  public:
    // Of the present stage:
    PooledVector<ProjectedSplat> splats;  // those that are not visible have no values
    PooledVector<ProjectedPlane> planes;  // of the same splats, for 2dgs only
    std::vector<BinItem> items;           // entries of one visible splat each, nearest first

    SplatScene(const MsSplats &cloud, const MsCamera &camera, const Grid &grid, int threads)
        : cloud_(cloud),
          camera_(camera),
          grid_(grid),
          projection_(camera, grid.samples),
          stages_(cloud, projection_, grid),
          found_(stages_.count()),
          threads_(threads) {
        MS_ASSERT(cloud.count >= 0 && cloud.count <= INT32_MAX);
        MS_ASSERT(cloud.kernel >= KERNEL_3DGS && cloud.kernel <= KERNEL_2DGS);
        MS_ASSERT(cloud.sh_used <= cloud.sh_stored && cloud.dilation >= 0);
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                camera_center_[i] -= projection_.m[4 * k + i] * projection_.m[4 * k + 3];
        if (stages() > 1) find_candidates();
    }

    int stages() const { return stages_.count(); }

    // Goes on to a stage, whose splats lie behind those of earlier ones; without those that are on finished
    // tiles alone.
    void begin(int stage, const OpenTiles &open) {
        const std::vector<int32_t> &found = found_[stage];
        const int64_t count = stages() == 1 ? cloud_.count : (int64_t)found.size();
        splats.clear(), planes.clear();  // so that resize() copies nothing
        splats.resize(count);
        if (cloud_.kernel == KERNEL_2DGS) planes.resize(count);
        PooledVector<BinItem> candidates(count);
        parallel_blocks(threads_, count, BLOCK, [&](int64_t begin, int64_t end, int) {
            Candidate candidate;
            ProjectedPlane plane;
            for (int64_t k = begin; k < end; ++k) {
                const int64_t i = stages() == 1 ? k : found[k];
                BinItem &item = candidates[k];
                item.entry.length = 0;
                if (!is_candidate(i, open, candidate) || !project(i, candidate, open, splats[k], plane, item))
                    continue;
                item.entry = {candidate.key, (int32_t)k, 1};
                if (cloud_.kernel == KERNEL_2DGS) planes[k] = plane;
            }
        });
        items.clear();
        std::copy_if(candidates.begin(), candidates.end(), std::back_inserter(items),
                     [](const BinItem &item) { return item.entry.length; });
        sort_items(items);
    }

  private:
    const MsSplats &cloud_;
    const MsCamera &camera_;
    const Grid &grid_;
    const Projection projection_;
    const SplatStages stages_;
    std::vector<std::vector<int32_t>> found_;  // by stage: the splats that may be visible; empty: all, of one
    const int threads_;
    double camera_center_[3] = {0, 0, 0};  // world space

    // The box in the image where alpha may reach MIN_ALPHA, samples.
    struct Box {
        double low[2], high[2];
    };

    struct Candidate {
        Vec3 center;  // camera space
        float key;
        double x, y;  // projected centre, samples
    };

    static constexpr int64_t BLOCK = 1 << 13;  // splats

    void find_candidates() {
        const OpenTiles all(grid_);
        std::vector<std::vector<std::vector<int32_t>>> parts((cloud_.count + BLOCK - 1) / BLOCK);
        parallel_blocks(threads_, cloud_.count, BLOCK, [&](int64_t begin, int64_t end, int) {
            auto &part = parts[begin / BLOCK];
            part.resize(stages());
            Candidate candidate;
            for (int64_t i = begin; i < end; ++i)
                if (is_candidate(i, all, candidate)) part[stages_.of(candidate.key)].push_back((int32_t)i);
        });
        for (const auto &part : parts)
            for (int stage = 0; stage < stages(); ++stage)
                found_[stage].insert(found_[stage].end(), part[stage].begin(), part[stage].end());
    }

    // Whether splat i may be visible on an open tile.
    bool is_candidate(int64_t i, const OpenTiles &open, Candidate &out) const {
        const Vec3 c = out.center = projection_.to_camera(cloud_.means + 3 * i);
        if (!(c.z >= projection_.near)) return false;
        out.key = (float)(1 / c.z);
        const double opacity = cloud_.opacities[i];
        if (!(opacity >= MIN_ALPHA)) return false;
        out.x = projection_.fx * c.x / c.z + projection_.cx;
        out.y = projection_.fy * c.y / c.z + projection_.cy;
        if (cloud_.kernel == KERNEL_2DGS) return true;
        BinItem item;
        return find_tiles(bound(i, out, opacity), open, item);
    }

    // Projects splat i; false if it is not visible on an open tile. The item does not get its entry.
    bool project(int64_t i, const Candidate &candidate, const OpenTiles &open, ProjectedSplat &out,
                 ProjectedPlane &plane, BinItem &item) const {
        const Vec3 &c = candidate.center;
        const float *mean = cloud_.means + 3 * i;
        double opacity = cloud_.opacities[i];
        out.x = candidate.x, out.y = candidate.y;
        Box box;
        double axes[3][3];
        principal_axes(i, axes);
        bool visible = cloud_.kernel == KERNEL_2DGS ? project_plane(c, axes, opacity, out, plane, box)
                                                    : project_covariance(c, axes, opacity, out, box);
        if (!visible || !find_tiles(box, open, item)) return false;
        out.opacity = (float)opacity;
        out.low = (float)box.low[1];
        out.high = (float)box.high[1];
        double direction[3], length = 0;
        for (int k = 0; k < 3; ++k) {
            direction[k] = mean[k] - camera_center_[k];
            length += direction[k] * direction[k];
        }
        length = std::sqrt(length);
        for (double &d : direction) d /= length;
        sh_color(cloud_.sh + 3 * (int64_t)cloud_.sh_stored * i, cloud_.sh_used, direction, out.rgb);
        return true;
    }

    // The tiles that a box touches; false if none of them is open.
    bool find_tiles(const Box &box, const OpenTiles &open, BinItem &item) const {
        int x0, x1, y0, y1;
        if (!sample_range(box.low[0], box.high[0], grid_.width, x0, x1) ||
            !sample_range(box.low[1], box.high[1], grid_.height, y0, y1))
            return false;
        item.x0 = (uint16_t)grid_.tile_of(x0), item.x1 = (uint16_t)grid_.tile_of(x1);
        item.y0 = (uint16_t)grid_.tile_of(y0), item.y1 = (uint16_t)grid_.tile_of(y1);
        return open.any(item.x0, item.x1, item.y0, item.y1);
    }

    // A box around that of project_covariance, at a fraction of its cost: as if the splat were a ball of its
    // largest standard deviation.
    Box bound(int64_t i, const Candidate &candidate, double opacity) const {
        constexpr double slack = 1.01;  // rotations are orthonormal up to rounding
        const float *scale = cloud_.scales + 3 * i;
        const double radius = slack * std::max(std::max(scale[0], scale[1]), scale[2]) / candidate.center.z,
                     s = grid_.samples, stretch = s * s * squared_radius(opacity);
        double tx, ty;
        ray_slopes(candidate.center, tx, ty);
        const double x = camera_.fx * radius, y = camera_.fy * radius;
        const double rx = std::sqrt(stretch * (x * x * (1 + tx * tx) + cloud_.dilation)),
                     ry = std::sqrt(stretch * (y * y * (1 + ty * ty) + cloud_.dilation));
        return {{candidate.x - rx, candidate.y - ry}, {candidate.x + rx, candidate.y + ry}};
    }

    // The principal axes of splat i in camera space, as columns scaled by the standard deviations.
    void principal_axes(int64_t i, double axes[3][3]) const {
        const float *q = cloud_.quaternions + 4 * i, *scale = cloud_.scales + 3 * i;
        double w = q[0], x = q[1], y = q[2], z = q[3];
        double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
        for (int row = 0; row < 3; ++row)
            for (int col = 0; col < 3; ++col) {
                axes[row][col] = 0;
                for (int k = 0; k < 3; ++k) axes[row][col] += projection_.m[4 * row + k] * r[k][col];
                axes[row][col] *= scale[col];
            }
    }

    // Slopes x / z and y / z of the ray to c where the Jacobian is evaluated: as in 3DGS, at most 0.3 of the
    // half field of view outside the image.
    void ray_slopes(const Vec3 &c, double &tx, double &ty) const {
        const double fx = camera_.fx, fy = camera_.fy;
        const double margin_x = 0.15 * camera_.width / fx, margin_y = 0.15 * camera_.height / fy;
        auto clamped = [](double v, double low, double high) { return v < low ? low : v > high ? high : v; };
        tx = clamped(c.x / c.z, -camera_.cx / fx - margin_x, (camera_.width - camera_.cx) / fx + margin_x);
        ty = clamped(c.y / c.z, -camera_.cy / fy - margin_y, (camera_.height - camera_.cy) / fy + margin_y);
    }

    // EWA: the affine approximation of the projection at the centre c. Lowers the opacity for 'antialiased'.
    bool project_covariance(const Vec3 &c, const double axes[3][3], double &opacity, ProjectedSplat &out,
                            Box &box) const {
        const double s = grid_.samples, fx = camera_.fx, fy = camera_.fy;
        double tx, ty;
        ray_slopes(c, tx, ty);
        double jx[3], jy[3], cov[3] = {0, 0, 0}, undilated_det = 0;
        for (int k = 0; k < 3; ++k) {
            jx[k] = fx / c.z * (axes[0][k] - tx * axes[2][k]);
            jy[k] = fy / c.z * (axes[1][k] - ty * axes[2][k]);
            cov[0] += jx[k] * jx[k];
            cov[1] += jx[k] * jy[k];
            cov[2] += jy[k] * jy[k];
        }
        // The determinant as a sum of squares, by Lagrange's identity.
        for (int k = 0; k < 3; ++k) {
            double area = jx[k] * jy[(k + 1) % 3] - jx[(k + 1) % 3] * jy[k];
            undilated_det += area * area;
        }
        double dilation = cloud_.dilation, det = undilated_det + dilation * (cov[0] + cov[2] + dilation);
        cov[0] += dilation;
        cov[2] += dilation;
        if (!(det > 0) || !std::isfinite(det)) return false;
        if (cloud_.kernel == KERNEL_ANTIALIASED) {
            opacity *= std::sqrt(std::max(0.0, undilated_det / det));
            if (!(opacity >= MIN_ALPHA)) return false;
        }
        // A triangular factor of the inverse covariance.
        double along = 1 / (s * std::sqrt(cov[2])), across = along / std::sqrt(det);
        if (!std::isfinite(along) || !std::isfinite(across)) return false;
        out.m[0] = across * cov[2];
        out.m[1] = -across * cov[1];
        out.m[2] = along;
        double radius2 = squared_radius(opacity);
        double rx = s * std::sqrt(radius2 * cov[0]), ry = s * std::sqrt(radius2 * cov[2]);
        box.low[0] = out.x - rx, box.high[0] = out.x + rx;
        box.low[1] = out.y - ry, box.high[1] = out.y + ry;
        return true;
    }

    // Squared Mahalanobis distance at which alpha falls to MIN_ALPHA, and a little for rounding.
    static double squared_radius(double opacity) { return 2 * std::log(255 * opacity) + 1e-6; }

    bool project_plane(const Vec3 &c, const double axes[3][3], double opacity, const ProjectedSplat &splat,
                       ProjectedPlane &out, Box &box) const {
        // The homography (u, v, 1) -> image, relative to the projected centre.
        double center[3] = {c.x, c.y, c.z}, row[3][3];
        for (int k = 0; k < 3; ++k) {
            double column[3];
            for (int i = 0; i < 3; ++i) column[i] = k < 2 ? axes[i][k] : center[i];
            row[0][k] = projection_.fx * column[0] + (projection_.cx - splat.x) * column[2];
            row[1][k] = projection_.fy * column[1] + (projection_.cy - splat.y) * column[2];
            row[2][k] = column[2];
        }
        // Its inverse up to a factor: the adjugate, divided by the largest element of its last row.
        double largest = 0;
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < 3; ++i) {
                const double *a = row[(i + 1) % 3], *b = row[(i + 2) % 3];
                out.m[k][i] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
                if (k == 2) largest = std::max(largest, std::fabs(out.m[k][i]));
            }
        if (largest > 0)
            for (auto &coefficients : out.m)
                for (double &coefficient : coefficients) coefficient /= largest;
        for (int k = 0; k < 3; ++k) out.w[k] = (float)row[2][k];
        // Box of the projected disc u^2 + v^2 <= radius2 (a conic; unbounded if it reaches the camera plane),
        // joined with that of the low-pass filter around the centre.
        double radius2 = squared_radius(opacity);
        double low_pass = std::sqrt(radius2 * cloud_.dilation) * grid_.samples;
        double d = radius2 * (row[2][0] * row[2][0] + row[2][1] * row[2][1]) - row[2][2] * row[2][2];
        for (int i = 0; i < 2; ++i) {
            double origin = i ? splat.y : splat.x, middle = 0, half = std::numeric_limits<double>::infinity();
            if (d < 0) {
                double cross =
                    radius2 * (row[i][0] * row[2][0] + row[i][1] * row[2][1]) - row[i][2] * row[2][2];
                double square =
                    radius2 * (row[i][0] * row[i][0] + row[i][1] * row[i][1]) - row[i][2] * row[i][2];
                middle = cross / d;
                half = std::sqrt(std::max(0.0, middle * middle - square / d));
            }
            box.low[i] = origin + std::min(middle - half, -low_pass);
            box.high[i] = origin + std::max(middle + half, low_pass);
        }
        return true;
    }
};

}  // namespace ms
