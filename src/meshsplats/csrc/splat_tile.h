// Blends Gaussian splats as they were trained: whole splats, nearest first. As in 3D Gaussian Splatting,
// alpha is limited to 0.99, and a sample stops before the splat that would leave a transmittance below 1e-4.
#pragma once

#include <memory>

#include "splat_scene.h"

namespace ms {

constexpr float MAX_ALPHA = 0.99f, MIN_SPLAT_TRANSMITTANCE = 1e-4f;

// exp(x) for x <= 0 with a relative error of about 2e-7: Cody-Waite range reduction and a Taylor polynomial
// of degree 7. The same bits at every vector width.
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
    vf power_of_two;
    __builtin_memcpy(&power_of_two, &bits, sizeof power_of_two);
    return p * power_of_two;
}

// What is blended of a tile so far. Samples are stored in rows.
struct SplatSums {
    alignas(64) float red[TILE][TILE], green[TILE][TILE], blue[TILE][TILE], transmittance[TILE][TILE];
    uint32_t active[TILE];  // by row, one bit per column
};

// Renders the splats into one tile.
class SplatTile {
  public:
    SplatTile(const SplatScene &scene, const Grid &grid, const MsOptions &options, const MsImage &image,
              const MsCamera &camera, const MsSplats &cloud)
        : scene_(scene),
          grid_(grid),
          options_(options),
          image_(image),
          camera_(camera),
          planar_(cloud.kernel == KERNEL_2DGS),
          near_((float)camera.near),
          inverse_low_pass_(1 / std::max(cloud.dilation, 1e-6f) / (grid.samples * grid.samples)) {
        for (int i = 0; i < TILE; ++i) center_[i] = i + 0.5f;
    }

    int64_t fragments() const { return fragments_; }

    // Goes on with a tile; `left`: its sums after earlier stages, or null. Returns whether it is finished:
    // all its samples have stopped, or this is the `last` stage. Otherwise its sums are left there.
    bool render(int tile_x, int tile_y, const TileEntry *list, int64_t length, bool last,
                std::unique_ptr<SplatSums> &left) {
        int x0 = tile_x * grid_.tile_side, y0 = tile_y * grid_.tile_side;
        int columns = std::min(grid_.tile_side, grid_.width - x0),
            rows = std::min(grid_.tile_side, grid_.height - y0);
        MS_ASSERT(columns > 0 && rows > 0);
        if (left) {
            sums_ = *left;
        } else {
            sums_ = SplatSums();
            for (int y = 0; y < rows; ++y) sums_.active[y] = (1u << columns) - 1;
            for (auto &row : sums_.transmittance)
                for (float &transmittance : row) transmittance = 1;
        }
        for (int64_t i = 0; i < length; ++i) {
            MS_ASSERT(i == 0 || list[i].key <= list[i - 1].key);
            blend(list[i].first, x0, y0, rows);
            if (i % SPLATS_PER_CHECK == SPLATS_PER_CHECK - 1 && !active(rows)) break;
        }
        if (!last && active(rows)) {
            if (!left) left = std::make_unique<SplatSums>();
            *left = sums_;
            return false;
        }
        left.reset();
        resolve(x0, y0, columns, rows);
        return true;
    }

  private:
    static constexpr int SPLATS_PER_CHECK = 16;  // between checks whether the tile is finished

    const SplatScene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsImage &image_;
    const MsCamera &camera_;
    bool planar_;
    float near_, inverse_low_pass_;  // 1 / variance of the low-pass filter, 1 / square samples
    alignas(64) float center_[TILE];
    SplatSums sums_;
    int64_t fragments_ = 0;

    // A ProjectedSplat relative to the corner of a tile: u = a x + b y + c, v = d y + e, squared distance u^2
    // + v^2.
    struct TileSplat {
        float a, b, c, d, e;
    };
    // A ProjectedPlane relative to the corner of a tile, which is at (x, y) from the projected centre.
    struct TilePlane {
        float x, y, m[3][3], w[3];
    };

    static vf select_bits(unsigned chosen, vf yes, vf no) {
#if defined(__AVX512F__)
        return select((vm)chosen, yes, no);
#else
        typedef int vi __attribute__((vector_size(4 * W)));
        vi lane;
        for (int i = 0; i < W; ++i) lane[i] = (chosen >> i & 1) ? -1 : 0;
        return select((vm)lane, yes, no);
#endif
    }

    // Whether any sample goes on.
    bool active(int rows) const {
        uint32_t any = 0;
        for (int y = 0; y < rows; ++y) any |= sums_.active[y];
        return any;
    }

    // Blends one splat behind all earlier ones.
    void blend(int32_t index, int x0, int y0, int rows) {
        MS_ASSERT(index >= 0 && index < (int32_t)scene_.splats.size());
        const ProjectedSplat &splat = scene_.splats[index];
        // In double precision, because the offsets cancel where the centre is far away.
        const double dx = x0 - splat.x, dy = y0 - splat.y;
        TileSplat flat{};
        TilePlane plane;
        if (planar_)
            plane = plane_at(scene_.planes[index], dx, dy);
        else
            flat = splat_at(splat, dx, dy);
        vf opacity = set1(splat.opacity);
        // One more row on either side, for rounding.
        int first = (int)std::min(std::max(splat.low - y0 - 1, 0.0f), (float)rows);
        int last = (int)std::max(std::min(splat.high - y0, rows - 1.0f), -1.0f);
        for (int y = first; y <= last; ++y) {
            if (!sums_.active[y]) continue;
            const float v = flat.d * (y + 0.5f) + flat.e, row_u = flat.b * (y + 0.5f) + flat.c,
                        row_v2 = v * v;
            for (int x = 0; x < TILE; x += W) {
                unsigned active = (sums_.active[y] >> x) & ((1u << W) - 1);
                if (!active) continue;
                vf power;
                if (planar_) {
                    power = plane_power(plane, load(center_ + x), y + 0.5f);
                } else {
                    vf u = set1(flat.a) * load(center_ + x) + set1(row_u);
                    power = set1(-0.5f) * (u * u + set1(row_v2));
                }
                // Conservative and cheaper than exp: log(1/255) = -5.54.
                active &= greater_equal_bits(power, set1(-5.6f));
                if (!active) continue;
                vf alpha = vmin(opacity * exp_negative(power), set1(MAX_ALPHA));
                active &= greater_equal_bits(alpha, set1(MIN_ALPHA));
                if (!active) continue;
                vf transmittance = load(sums_.transmittance[y] + x);
                vf next = transmittance * (set1(1.0f) - alpha);
                unsigned blended = active & greater_equal_bits(next, set1(MIN_SPLAT_TRANSMITTANCE));
                sums_.active[y] &= ~((active & ~blended) << x);
                if (!blended) continue;
                vf weight = select_bits(blended, transmittance * alpha, set1(0.0f));
                store(sums_.red[y] + x, load(sums_.red[y] + x) + weight * set1(splat.rgb[0]));
                store(sums_.green[y] + x, load(sums_.green[y] + x) + weight * set1(splat.rgb[1]));
                store(sums_.blue[y] + x, load(sums_.blue[y] + x) + weight * set1(splat.rgb[2]));
                store(sums_.transmittance[y] + x, select_bits(blended, next, transmittance));
                fragments_ += __builtin_popcount(blended);
            }
        }
    }

    static TileSplat splat_at(const ProjectedSplat &splat, double dx, double dy) {
        return {(float)splat.m[0], (float)splat.m[1], (float)(splat.m[0] * dx + splat.m[1] * dy),
                (float)splat.m[2], (float)(splat.m[2] * dy)};
    }
    static TilePlane plane_at(const ProjectedPlane &from, double dx, double dy) {
        TilePlane plane;
        for (int k = 0; k < 3; ++k) {
            plane.m[k][0] = (float)from.m[k][0];
            plane.m[k][1] = (float)from.m[k][1];
            plane.m[k][2] = (float)(from.m[k][0] * dx + from.m[k][1] * dy + from.m[k][2]);
            plane.w[k] = from.w[k];
        }
        plane.x = (float)dx;
        plane.y = (float)dy;
        return plane;
    }

    // -1/2 the squared distance in the splat's plane, or to the centre in the image by the low-pass filter if
    // that is less.
    vf plane_power(const TilePlane &s, vf x, float y) const {
        vf p[3];
        for (int k = 0; k < 3; ++k) p[k] = set1(s.m[k][0]) * x + set1(s.m[k][1] * y + s.m[k][2]);
        vf u = p[0] / p[2], v = p[1] / p[2], square = u * u + v * v;
        vf depth = set1(s.w[0]) * u + set1(s.w[1]) * v + set1(s.w[2]);
        vf dx = x + set1(s.x);
        float dy = y + s.y;
        vf low_pass = set1(inverse_low_pass_) * (dx * dx + set1(dy * dy));
        // A ray parallel to the plane makes `square` NaN, and comparisons with NaN are false.
        vm hit = mask_and(greater_equal(depth, set1(near_)), greater(low_pass, square));
        return set1(-0.5f) * select(hit, square, low_pass);
    }

    // Averages the samples of each pixel and writes the pixels.
    void resolve(int x0, int y0, int columns, int rows) {
        int s = grid_.samples;
        for (int y = 0; y < rows; y += s)
            for (int x = 0; x < columns; x += s) {
                int64_t pixel = (int64_t)((y0 + y) / s) * camera_.width + (x0 + x) / s;
                float mean[4] = {0, 0, 0, 0};
                for (int j = y; j < y + s; ++j)
                    for (int i = x; i < x + s; ++i) {
                        mean[0] += sums_.red[j][i];
                        mean[1] += sums_.green[j][i];
                        mean[2] += sums_.blue[j][i];
                        mean[3] += sums_.transmittance[j][i];
                    }
                for (float &value : mean) value /= s * s;
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c) image_.color[3 * pixel + c] = mean[c] + mean[3] * background[c];
                image_.alpha[pixel] = 1 - mean[3];
            }
    }
};

}  // namespace ms
