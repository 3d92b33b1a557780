// Draws Gaussian splats the way they were trained: whole splats in the order of their centres' depth.
//
// EWA projection (Zwicker et al. 2001) with the conventions of 3D Gaussian Splatting (Kerbl et al. 2023):
// widening of the projected covariance, opacity below 1/255 skipped and at most 0.99, a sample ends before
// the splat that would leave less than 1e-4 of the light. '2dgs' follows Huang et al. 2024: the ray meets the
// splat's plane.
#pragma once

#include <memory>

#include "grid.h"
#include "triangle.h"

namespace ms {

constexpr float ALPHA_CUT = 1.0f / 255, ALPHA_MOST = 0.99f, LIGHT_LEFT = 1e-4f;

struct FlatSplat {
    double x, y;  // projected centre, samples
    // The squared distance in standard deviations is (m[0] dx + m[1] dy)^2 + (m[2] dy)^2: a sum of squares
    // stays exact for thin splats, where the usual quadratic form cancels. Not used by 2dgs.
    double m[3];
    float low, high;  // rows reached
    float opacity;
    float rgb[3];
};

// 2dgs: the ray through the centre plus (dx, dy) meets the splat's plane at u = m[0] . (dx, dy, 1) / m[2] .
// (dx, dy, 1) standard deviations along the first axis, v likewise with m[1], at the depth w . (u, v, 1).
struct FlatPlane {
    double m[3][3];
    float w[3];
};

// exp of x <= 0, relative error about 2e-7; the same bits at every vector width.
inline vf exp_negative(vf x) {
    typedef int32_t vi __attribute__((vector_size(4 * W)));
    x = vmax(x, set1(-87.0f));
    vf scaled = x * set1(1.44269504f);
    vi n = __builtin_convertvector(scaled - set1(0.5f), vi);
    vf whole = __builtin_convertvector(n, vf);
    vf r = (x - whole * set1(0.693359375f)) + whole * set1(2.12194440e-4f);
    vf p = set1(1.0f / 5040);
    for (float c : {1.0f / 720, 1.0f / 120, 1.0f / 24, 1.0f / 6, 0.5f, 1.0f, 1.0f}) p = p * r + set1(c);
    vi bits = (n + 127) << 23;
    vf two;
    __builtin_memcpy(&two, &bits, sizeof two);
    return p * two;
}

// Display colour seen along the unit direction d: max(0, 1/2 + sum of coefficients times real spherical
// harmonics); of degree 0 alone, the colour that a vertex can carry, at most 1.
inline void sh_color(const float *sh, int used, const double d[3], float rgb[3]) {
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
    std::vector<FlatSplat> splats;  // visible ones
    std::vector<FlatPlane> planes;  // theirs, for 2dgs only
    std::vector<Item> items;        // runs of one of `splats`, nearest first

    SplatScene(const MsSplats &cloud, const MsCamera &camera, const Grid &grid, int threads)
        : cloud_(cloud), camera_(camera), grid_(grid), projection_(camera, grid.samples) {
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) position_[i] -= projection_.m[4 * k + i] * projection_.m[4 * k + 3];
        constexpr int64_t block = 1 << 13;
        struct Part {
            std::vector<FlatSplat> splats;
            std::vector<FlatPlane> planes;
            std::vector<Item> items;
        };
        std::vector<Part> parts((cloud.count + block - 1) / block);
        parallel_blocks(threads, cloud.count, block, [&](int64_t a, int64_t b, int) {
            Part &part = parts[a / block];
            FlatSplat splat;
            FlatPlane plane;
            Item item;
            for (int64_t i = a; i < b; ++i)
                if (project(i, splat, plane, item)) {
                    part.splats.push_back(splat);
                    if (cloud_.kernel == 2) part.planes.push_back(plane);
                    part.items.push_back(item);
                }
        });
        for (auto &part : parts) {
            for (size_t i = 0; i < part.items.size(); ++i) {
                part.items[i].entry.first = (int32_t)splats.size();
                splats.push_back(part.splats[i]);
                items.push_back(part.items[i]);
            }
            planes.insert(planes.end(), part.planes.begin(), part.planes.end());
            part = Part();
        }
        sort_items(items);
    }

  private:
    const MsSplats &cloud_;
    const MsCamera &camera_;
    const Grid &grid_;
    Projection projection_;
    double position_[3] = {0, 0, 0};

    bool project(int64_t i, FlatSplat &out, FlatPlane &on_plane, Item &item) const {
        const float *mean = cloud_.means + 3 * i, *q = cloud_.quaternions + 4 * i,
                    *scale = cloud_.scales + 3 * i;
        Vec3 c = projection_.to_camera(mean);
        if (!(c.z >= projection_.near)) return false;
        double opacity = cloud_.opacities[i];
        if (!(opacity >= ALPHA_CUT)) return false;

        // The splat's axes in camera space, as columns scaled by the standard deviations.
        double w = q[0], x = q[1], y = q[2], z = q[3];
        double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
        double axes[3][3];
        for (int row = 0; row < 3; ++row)
            for (int col = 0; col < 3; ++col) {
                axes[row][col] = 0;
                for (int k = 0; k < 3; ++k) axes[row][col] += projection_.m[4 * row + k] * r[k][col];
                axes[row][col] *= scale[col];
            }
        out.x = projection_.fx * c.x / c.z + projection_.cx;
        out.y = projection_.fy * c.y / c.z + projection_.cy;
        double lo[2], hi[2];
        bool visible = cloud_.kernel == 2 ? plane(c, axes, opacity, out, on_plane, lo, hi)
                                          : footprint(c, axes, opacity, out, lo, hi);
        int x0, x1, y0, y1;
        if (!visible || !sample_range(lo[0], hi[0], grid_.width, x0, x1) ||
            !sample_range(lo[1], hi[1], grid_.height, y0, y1))
            return false;
        out.opacity = (float)opacity;
        out.low = (float)lo[1];
        out.high = (float)hi[1];
        double direction[3], length = 0;
        for (int k = 0; k < 3; ++k) {
            direction[k] = mean[k] - position_[k];
            length += direction[k] * direction[k];
        }
        length = std::sqrt(length);
        for (double &d : direction) d /= length;
        sh_color(cloud_.sh + 3 * (int64_t)cloud_.sh_stored * i, cloud_.sh_used, direction, out.rgb);
        item = {{(float)(1 / c.z), 0, 1},
                (uint16_t)grid_.tile_of(x0),
                (uint16_t)grid_.tile_of(x1),
                (uint16_t)grid_.tile_of(y0),
                (uint16_t)grid_.tile_of(y1)};
        return true;
    }

    bool footprint(const Vec3 &c, const double axes[3][3], double &opacity, FlatSplat &out, double lo[2],
                   double hi[2]) const {
        // The Jacobian of the projection, taken no farther than 0.3 of the half field of view outside the
        // picture.
        double s = grid_.samples, fx = camera_.fx, fy = camera_.fy;
        double margin_x = 0.15 * camera_.width / fx, margin_y = 0.15 * camera_.height / fy;
        auto limit = [](double v, double low, double high) { return v < low ? low : v > high ? high : v; };
        double tx =
            limit(c.x / c.z, -camera_.cx / fx - margin_x, (camera_.width - camera_.cx) / fx + margin_x);
        double ty =
            limit(c.y / c.z, -camera_.cy / fy - margin_y, (camera_.height - camera_.cy) / fy + margin_y);
        double jx[3], jy[3], cov[3] = {0, 0, 0}, det_before = 0;
        for (int k = 0; k < 3; ++k) {
            jx[k] = fx / c.z * (axes[0][k] - tx * axes[2][k]);
            jy[k] = fy / c.z * (axes[1][k] - ty * axes[2][k]);
            cov[0] += jx[k] * jx[k];
            cov[1] += jx[k] * jy[k];
            cov[2] += jy[k] * jy[k];
        }
        // The determinant by Lagrange's identity: a sum of squares again.
        for (int k = 0; k < 3; ++k) {
            double area = jx[k] * jy[(k + 1) % 3] - jx[(k + 1) % 3] * jy[k];
            det_before += area * area;
        }
        double widening = cloud_.dilation, det = det_before + widening * (cov[0] + cov[2] + widening);
        cov[0] += widening;
        cov[2] += widening;
        if (!(det > 0) || !std::isfinite(det)) return false;
        if (cloud_.kernel == 1) {
            opacity *= std::sqrt(std::max(0.0, det_before / det));
            if (!(opacity >= ALPHA_CUT)) return false;
        }
        double along = 1 / (s * std::sqrt(cov[2])), across = along / std::sqrt(det);
        if (!std::isfinite(along) || !std::isfinite(across)) return false;
        out.m[0] = across * cov[2];
        out.m[1] = -across * cov[1];
        out.m[2] = along;
        double radius2 = 2 * std::log(255 * opacity) + 1e-6;
        double rx = s * std::sqrt(radius2 * cov[0]), ry = s * std::sqrt(radius2 * cov[2]);
        lo[0] = out.x - rx, hi[0] = out.x + rx, lo[1] = out.y - ry, hi[1] = out.y + ry;
        return true;
    }

    bool plane(const Vec3 &c, const double axes[3][3], double opacity, const FlatSplat &splat, FlatPlane &out,
               double lo[2], double hi[2]) const {
        // Columns of the map (u, v, 1) -> picture; x and y counted from the projected centre.
        double center[3] = {c.x, c.y, c.z}, row[3][3];
        for (int k = 0; k < 3; ++k) {
            double column[3];
            for (int i = 0; i < 3; ++i) column[i] = k < 2 ? axes[i][k] : center[i];
            row[0][k] = projection_.fx * column[0] + (projection_.cx - splat.x) * column[2];
            row[1][k] = projection_.fy * column[1] + (projection_.cy - splat.y) * column[2];
            row[2][k] = column[2];
        }
        // The inverse of that map, but for a factor, which is chosen to keep the numbers small.
        double largest = 0;
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < 3; ++i) {
                const double *a = row[(i + 1) % 3], *b = row[(i + 2) % 3];
                out.m[k][i] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
                if (k == 2) largest = std::max(largest, std::fabs(out.m[k][i]));
            }
        if (largest > 0)
            for (auto &numbers : out.m)
                for (double &number : numbers) number /= largest;
        for (int k = 0; k < 3; ++k) out.w[k] = (float)row[2][k];
        // Box of the disc u^2 + v^2 <= radius^2 on the picture, and of the low pass round the centre.
        double radius2 = 2 * std::log(255 * opacity) + 1e-6;
        double low_pass = std::sqrt(radius2 * cloud_.dilation) * grid_.samples;
        double d = radius2 * (row[2][0] * row[2][0] + row[2][1] * row[2][1]) - row[2][2] * row[2][2];
        for (int i = 0; i < 2; ++i) {
            double at = i ? splat.y : splat.x, middle = 0, half = std::numeric_limits<double>::infinity();
            if (d < 0) {
                double cross =
                    radius2 * (row[i][0] * row[2][0] + row[i][1] * row[2][1]) - row[i][2] * row[2][2];
                double square =
                    radius2 * (row[i][0] * row[i][0] + row[i][1] * row[i][1]) - row[i][2] * row[i][2];
                middle = cross / d;
                half = std::sqrt(std::max(0.0, middle * middle - square / d));
            }
            lo[i] = at + std::min(middle - half, -low_pass);
            hi[i] = at + std::max(middle + half, low_pass);
        }
        return true;
    }
};

// One tile of the picture of the splats.
class SplatTile {
  public:
    SplatTile(const SplatScene &scene, const Grid &grid, const MsOptions &options, const MsPicture &picture,
              const MsCamera &camera, const MsSplats &cloud)
        : scene_(scene),
          grid_(grid),
          options_(options),
          picture_(picture),
          camera_(camera),
          planar_(cloud.kernel == 2),
          near_((float)camera.near),
          low_pass_(1 / std::max(cloud.dilation, 1e-6f) / (grid.samples * grid.samples)) {
        for (int i = 0; i < TILE; ++i) center_[i] = i + 0.5f;
    }

    int64_t fragments() const { return fragments_; }

    void draw(int tile_x, int tile_y, const Entry *list, int64_t length) {
        int x0 = tile_x * grid_.side, y0 = tile_y * grid_.side;
        int columns = std::min(grid_.side, grid_.width - x0), rows = std::min(grid_.side, grid_.height - y0);
        for (int y = 0; y < TILE; ++y)
            for (int x = 0; x < TILE; ++x) {
                red_[y][x] = green_[y][x] = blue_[y][x] = 0;
                through_[y][x] = 1;
            }
        for (int y = 0; y < rows; ++y) open_[y] = (1u << columns) - 1;
        for (int64_t i = 0; i < length; ++i) {
            add(list[i].first, x0, y0, rows);
            if ((i & 15) == 15) {
                uint32_t any = 0;
                for (int y = 0; y < rows; ++y) any |= open_[y];
                if (!any) break;
            }
        }
        finish(x0, y0, columns, rows);
    }

  private:
    const SplatScene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsPicture &picture_;
    const MsCamera &camera_;
    bool planar_;
    float near_, low_pass_;
    alignas(64) float center_[TILE];
    alignas(64) float red_[TILE][TILE], green_[TILE][TILE], blue_[TILE][TILE], through_[TILE][TILE];
    uint32_t open_[TILE];
    int64_t fragments_ = 0;

    // A FlatPlane counted from the corner of a tile, which is at (x, y) from the splat's centre.
    struct Plane {
        float x, y, m[3][3], w[3];
    };

    static vf pick(unsigned chosen, vf yes, vf no) {
#if defined(__AVX512F__)
        return ms::pick((vm)chosen, yes, no);
#else
        typedef int vi __attribute__((vector_size(4 * W)));
        vi lane;
        for (int i = 0; i < W; ++i) lane[i] = (chosen >> i & 1) ? -1 : 0;
        return ms::pick((vm)lane, yes, no);
#endif
    }

    void add(int32_t number, int x0, int y0, int rows) {
        const FlatSplat &splat = scene_.splats[number];
        // Counted from the tile's corner in double, so that what is left is small where the centre is far
        // away.
        const double dx = x0 - splat.x, dy = y0 - splat.y;
        float a = 0, b = 0, c = 0, d = 0, e = 0;
        Plane plane;
        if (planar_) {
            const FlatPlane &from = scene_.planes[number];
            for (int k = 0; k < 3; ++k) {
                plane.m[k][0] = (float)from.m[k][0];
                plane.m[k][1] = (float)from.m[k][1];
                plane.m[k][2] = (float)(from.m[k][0] * dx + from.m[k][1] * dy + from.m[k][2]);
                plane.w[k] = from.w[k];
            }
            plane.x = (float)dx;
            plane.y = (float)dy;
        } else {
            a = (float)splat.m[0];
            b = (float)splat.m[1];
            c = (float)(splat.m[0] * dx + splat.m[1] * dy);
            d = (float)splat.m[2];
            e = (float)(splat.m[2] * dy);
        }
        vf opacity = set1(splat.opacity);
        // A row more on either side, for rounding.
        int first = (int)std::min(std::max(splat.low - y0 - 1, 0.0f), (float)rows);
        int last = (int)std::max(std::min(splat.high - y0, rows - 1.0f), -1.0f);
        for (int y = first; y <= last; ++y) {
            if (!open_[y]) continue;
            const float v = d * (y + 0.5f) + e, row_u = b * (y + 0.5f) + c, row_v2 = v * v;
            for (int x = 0; x < TILE; x += W) {
                unsigned open = (open_[y] >> x) & ((1u << W) - 1);
                if (!open) continue;
                vf power;
                if (planar_) {
                    power = on_plane(plane, load(center_ + x), y + 0.5f);
                } else {
                    vf u = set1(a) * load(center_ + x) + set1(row_u);
                    power = set1(-0.5f) * (u * u + set1(row_v2));
                }
                // A bound cheaper than exp: below it alpha is under the cut.
                open &= at_least(power, set1(-5.6f));
                if (!open) continue;
                vf alpha = vmin(opacity * exp_negative(power), set1(ALPHA_MOST));
                open &= at_least(alpha, set1(ALPHA_CUT));
                if (!open) continue;
                vf through = load(through_[y] + x);
                vf after = through * (set1(1.0f) - alpha);
                unsigned blends = open & at_least(after, set1(LIGHT_LEFT));
                open_[y] &= ~((open & ~blends) << x);
                if (!blends) continue;
                vf weight = pick(blends, through * alpha, set1(0.0f));
                store(red_[y] + x, load(red_[y] + x) + weight * set1(splat.rgb[0]));
                store(green_[y] + x, load(green_[y] + x) + weight * set1(splat.rgb[1]));
                store(blue_[y] + x, load(blue_[y] + x) + weight * set1(splat.rgb[2]));
                store(through_[y] + x, pick(blends, after, through));
                fragments_ += __builtin_popcount(blends);
            }
        }
    }

    vf on_plane(const Plane &s, vf x, float y) const {
        vf p[3];
        for (int k = 0; k < 3; ++k) p[k] = set1(s.m[k][0]) * x + set1(s.m[k][1] * y + s.m[k][2]);
        vf u = p[0] / p[2], v = p[1] / p[2], square = u * u + v * v;
        vf depth = set1(s.w[0]) * u + set1(s.w[1]) * v + set1(s.w[2]);
        vf dx = x + set1(s.x);
        float dy = y + s.y;
        vf low_pass = set1(low_pass_) * (dx * dx + set1(dy * dy));
        // Where the ray meets no plane the square is no number, which is not less than anything.
        vm met = both(not_less(depth, set1(near_)), greater(low_pass, square));
        return set1(-0.5f) * ms::pick(met, square, low_pass);
    }

    void finish(int x0, int y0, int columns, int rows) {
        int s = grid_.samples;
        float share = 1.0f / (s * s);
        for (int y = 0; y < rows; y += s)
            for (int x = 0; x < columns; x += s) {
                int64_t pixel = (int64_t)((y0 + y) / s) * camera_.width + (x0 + x) / s;
                float sum[4] = {0, 0, 0, 0};
                for (int j = y; j < y + s; ++j)
                    for (int i = x; i < x + s; ++i) {
                        sum[0] += red_[j][i];
                        sum[1] += green_[j][i];
                        sum[2] += blue_[j][i];
                        sum[3] += through_[j][i];
                    }
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c)
                    picture_.color[3 * pixel + c] = sum[c] * share + sum[3] * share * background[c];
                picture_.alpha[pixel] = 1 - sum[3] * share;
            }
    }
};

}  // namespace ms
