// PatchMatch stereo with slanted support windows (Bleyer, Rhemann and Rother 2011): each pixel has a plane,
// inverse depth and its slope in the image, improved by propagation from pixels nearby and by small random
// perturbations.
#pragma once

#include "parallel.h"
#include "photos.h"

namespace ms {

// The planes of an image, (height, width) each.
struct PlaneMaps {
    float *inverse;  // depth, at the middle of a pixel
    float *along_x, *along_y;
    float *score;
};

// Slopes of `inverse` (height, width): the plane through the pixels of a window whose difference to the
// middle one is at most `tolerance` per pixel of distance; 0 where there are few.
inline void fit_slopes(int width, int height, const float *inverse, float tolerance, float *along_x,
                       float *along_y) {
    constexpr int REACH = 3, FEWEST = 12;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const size_t i = (size_t)y * width + x;
            float n = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0, sq = 0, sxq = 0, syq = 0;
            for (int v = std::max(y - REACH, 0); v <= std::min(y + REACH, height - 1); ++v)
                for (int u = std::max(x - REACH, 0); u <= std::min(x + REACH, width - 1); ++u) {
                    const float dx = (float)(u - x), dy = (float)(v - y),
                                d = inverse[(size_t)v * width + u] - inverse[i];
                    if (!(d * d <= tolerance * tolerance * std::max(1.0f, dx * dx + dy * dy))) continue;
                    n += 1, sx += dx, sy += dy, sxx += dx * dx, sxy += dx * dy, syy += dy * dy;
                    sq += d, sxq += dx * d, syq += dy * d;
                }
            const float a = sxx - sx * sx / n, b = sxy - sx * sy / n, c = syy - sy * sy / n;
            const float e = sxq - sx * sq / n, f = syq - sy * sq / n, determinant = a * c - b * b;
            const bool enough = n >= FEWEST && determinant > 1;
            along_x[i] = enough ? (e * c - f * b) / determinant : 0;
            along_y[i] = enough ? (f * a - e * b) / determinant : 0;
        }
}

class PatchMatch {
  public:
    // Depths are between `low` and `high`, inverse. Random changes depend on the pixel alone.
    PatchMatch(const GreyImage &grey, const MsCamera &camera, const std::vector<Warp> &warps,
               const std::vector<const GreyImage *> &images, float low, float high, const PlaneMaps &maps)
        : width_(grey.width),
          height_(grey.height),
          pitch_(grey.width + 2 * REACH + 2 * W),
          grey_((size_t)pitch_ * (grey.height + 2 * REACH)),
          warps_(warps),
          images_(images),
          fx_((float)camera.fx),
          fy_((float)camera.fy),
          cx_((float)camera.cx),
          cy_((float)camera.cy),
          low_(low),
          high_(high),
          maps_(maps) {
        for (int y = 0; y < height_ + 2 * REACH; ++y)
            for (int x = 0; x < pitch_; ++x) grey_[(size_t)y * pitch_ + x] = grey.at(x - REACH, y - REACH);
        for (int dy = -REACH; dy <= REACH; ++dy)
            for (int dx = -REACH; dx <= REACH; ++dx)
                if ((dx + dy) % 2 == 0) offsets_[samples_++] = {dx, dy};
    }

    // Scores the planes as they are, then takes better ones, `rounds` times. Red and black pixels take turns:
    // those of one colour look at planes of the other one only, so their order does not matter.
    void run(int rounds) {
        for (int round = -1; round < rounds; ++round)
            for (int color = 0; color < 2; ++color)
                for (int y = 0; y < height_; ++y) {
                    stop_point();
                    for (int x = (y + color) % 2; x < width_; x += 2 * W) improve(x, y, round);
                }
    }

  private:
    static constexpr int REACH = 3, SAMPLES = 25;  // every second pixel of 7 x 7
    static constexpr float SIMILAR = 30;  // difference of grey values at which a pixel has half the weight
    static constexpr float STEEPEST = 0.03f;  // least squared cosine between a plane's normal and the ray

    struct Offset {
        int x, y;
    };
    struct Plane {
        vf q, x, y;
    };
    // W pixels of one colour beside each other.
    struct Pixels {
        vf x;
        float y;
        size_t index[W];
        vf values[SAMPLES], weights[SAMPLES];
        vf inverse_sum, mean, deviation;
    };

    static Plane select_plane(vm mask, const Plane &yes, const Plane &no) {
        return {select(mask, yes.q, no.q), select(mask, yes.x, no.x), select(mask, yes.y, no.y)};
    }

    vf load_at(const float *values, const Pixels &at) const {
        vf result{};
        for (int lane = 0; lane < W; ++lane) result[lane] = values[at.index[lane]];
        return result;
    }

    Pixels pixels(int x, int y) const {
        Pixels p;
        p.y = (float)y + 0.5f;
        vf own{};
        const float *row = &grey_[(size_t)(y + REACH) * pitch_ + REACH];
        for (int lane = 0; lane < W; ++lane) {
            const int column = std::min(x + 2 * lane, width_ - 1);
            p.index[lane] = (size_t)y * width_ + column;
            p.x[lane] = (float)column + 0.5f;
            own[lane] = row[column];
        }
        vf sum = set1(0), sum_values = set1(0), squares = set1(0);
        for (int i = 0; i < SAMPLES; ++i) {
            const float *place = row + offsets_[i].y * pitch_ + x + offsets_[i].x;
            vf value{};
            for (int lane = 0; lane < W; ++lane) value[lane] = place[2 * lane];
            const vf difference = value - own;
            const vf weight = 1 / (1 + difference * difference * (1 / (SIMILAR * SIMILAR)));
            p.values[i] = value, p.weights[i] = weight;
            sum += weight, sum_values += weight * value, squares += weight * value * value;
        }
        p.inverse_sum = 1 / sum;
        p.mean = sum_values * p.inverse_sum;
        p.deviation = vsqrt(vmax(squares * p.inverse_sum - p.mean * p.mean, set1(PLAIN)));
        return p;
    }

    // The mean of the two best correlations of the windows in the other photographs, for which the plane's
    // homography is taken as affine around the pixel.
    vf score(const Pixels &p, const Plane &plane) const {
        BestTwo best;
        for (size_t k = 0; k < warps_.size(); ++k) {
            const Warp &warp = warps_[k];
            const vf z = warp.row(2, p.x, p.y, plane.q), inverse_z = 1 / vmax(z, set1(1e-6f));
            const vf u = warp.row(0, p.x, p.y, plane.q) * inverse_z,
                     v = warp.row(1, p.x, p.y, plane.q) * inverse_z;
            auto slope = [&](int row, int column, vf along, vf at) {
                const vf z_slope = warp.turn[6 + column] + along * warp.shift[2];
                return (warp.turn[3 * row + column] + along * warp.shift[row] - at * z_slope) * inverse_z;
            };
            const vf u_x = slope(0, 0, plane.x, u), u_y = slope(0, 1, plane.y, u);
            const vf v_x = slope(1, 0, plane.x, v), v_y = slope(1, 1, plane.y, v);
            vf sum = set1(0), squares = set1(0), products = set1(0);
            for (int i = 0; i < SAMPLES; ++i) {
                const float dx = (float)offsets_[i].x, dy = (float)offsets_[i].y;
                const vf value = sample(*images_[k], u + dx * u_x + dy * u_y, v + dx * v_x + dy * v_y);
                const vf weighted = p.weights[i] * value;
                sum += weighted, squares += weighted * value, products += weighted * p.values[i];
            }
            const vf mean = sum * p.inverse_sum;
            const vf deviation = vsqrt(vmax(squares * p.inverse_sum - mean * mean, set1(PLAIN)));
            const vf correlation = (products * p.inverse_sum - mean * p.mean) / (deviation * p.deviation);
            best.add(select(in_image(warp, u, v, z), correlation, set1(BestTwo::UNSEEN)));
        }
        return best.score();
    }

    // Whether depths are in range, and the camera sees the front of the plane, not its edge.
    vm possible(const Pixels &p, const Plane &plane) const {
        const vf ray_x = (p.x - cx_) * (1 / fx_);
        const float ray_y = (p.y - cy_) * (1 / fy_);
        const vf nx = plane.x * fx_, ny = plane.y * fy_, nz = plane.q - nx * ray_x - ny * ray_y;
        const vf lengths = (nx * nx + ny * ny + nz * nz) * (ray_x * ray_x + (1 + ray_y * ray_y));
        return mask_and(mask_and(greater_equal(plane.q, set1(low_)), greater_equal(set1(high_), plane.q)),
                        greater(plane.q * plane.q, STEEPEST * lengths));
    }

    void try_plane(const Pixels &p, const Plane &candidate, Plane &plane, vf &best) const {
        const vm valid = possible(p, candidate);
        if (!bits(valid)) return;
        const vf found = score(p, candidate);
        const vm better = mask_and(valid, greater(found, best + 1e-4f));
        plane = select_plane(better, candidate, plane);
        best = select(better, found, best);
    }

    // The plane of the pixel with the best score of three in a direction, continued to here.
    Plane from_beside(const Pixels &p, int x, int y, int step_x, int step_y) const {
        Plane found{};
        for (int lane = 0; lane < W; ++lane) {
            const int column = std::min(x + 2 * lane, width_ - 1);
            size_t best = p.index[lane];
            float best_score = -2;
            int away = 0;
            for (int distance : {1, 3, 7}) {
                const int u = column + distance * step_x, v = y + distance * step_y;
                if (u < 0 || v < 0 || u >= width_ || v >= height_) break;
                const size_t other = (size_t)v * width_ + u;
                if (maps_.score[other] > best_score)
                    best_score = maps_.score[other], best = other, away = distance;
            }
            const float slope_x = maps_.along_x[best], slope_y = maps_.along_y[best];
            found.x[lane] = slope_x, found.y[lane] = slope_y;
            found.q[lane] =
                maps_.inverse[best] - (float)away * ((float)step_x * slope_x + (float)step_y * slope_y);
        }
        return found;
    }

    // Numbers between -1 and 1, other ones for every pixel, round and `turn`.
    vf random(const Pixels &p, int round, int turn) const {
        vf result{};
        for (int lane = 0; lane < W; ++lane) {
            uint32_t h = (uint32_t)p.index[lane] * 0x85EBCA77u ^ (uint32_t)(16 * round + turn) * 0xC2B2AE3Du;
            h = (h ^ h >> 15) * 0x2C1B3C6Du, h = (h ^ h >> 12) * 0x297A2D39u, h ^= h >> 15;
            result[lane] = (float)(int32_t)h * (1.0f / 2147483648.0f);
        }
        return result;
    }

    void improve(int x, int y, int round) {
        const Pixels p = pixels(x, y);
        Plane plane{load_at(maps_.inverse, p), load_at(maps_.along_x, p), load_at(maps_.along_y, p)};
        vf best;
        if (round < 0) {
            const vm valid = possible(p, plane);
            plane.x = select(valid, plane.x, set1(0)), plane.y = select(valid, plane.y, set1(0));
            best = score(p, plane);
            try_plane(p, {plane.q, set1(0), set1(0)}, plane, best);
        } else {
            best = load_at(maps_.score, p);
            try_plane(p, from_beside(p, x, y, 1, 0), plane, best);
            try_plane(p, from_beside(p, x, y, -1, 0), plane, best);
            try_plane(p, from_beside(p, x, y, 0, 1), plane, best);
            try_plane(p, from_beside(p, x, y, 0, -1), plane, best);
            if (!warps_.empty()) {
                const float reach = 1.5f / (float)(1 << std::min(round, 4));
                const vf pixel = reach * inverse_of_a_pixel(p, plane);
                auto change = [&](float turn, float tilt, int first) {
                    const vf slopes = tilt * pixel;
                    return Plane{plane.q + turn * pixel * random(p, round, first),
                                 plane.x + slopes * random(p, round, first + 1),
                                 plane.y + slopes * random(p, round, first + 2)};
                };
                try_plane(p, change(1, 0, 0), plane, best);
                try_plane(p, change(0, 0.3f, 3), plane, best);
                try_plane(p, change(0.4f, 0.15f, 6), plane, best);
            }
        }
        for (int lane = 0; lane < W && x + 2 * lane < width_; ++lane) {
            const size_t i = p.index[lane];
            maps_.inverse[i] = plane.q[lane];
            maps_.along_x[i] = plane.x[lane], maps_.along_y[i] = plane.y[lane];
            maps_.score[i] = best[lane];
        }
    }

    // Change of the inverse depth that moves the place by a pixel of the first other photograph.
    vf inverse_of_a_pixel(const Pixels &p, const Plane &plane) const {
        const Warp &warp = warps_.front();
        const vf z = warp.row(2, p.x, p.y, plane.q), inverse_z = 1 / vmax(z, set1(1e-6f));
        const vf u = warp.row(0, p.x, p.y, plane.q) * inverse_z,
                 v = warp.row(1, p.x, p.y, plane.q) * inverse_z;
        const vf du = (warp.shift[0] - u * warp.shift[2]) * inverse_z,
                 dv = (warp.shift[1] - v * warp.shift[2]) * inverse_z;
        return 1 / vmax(vsqrt(du * du + dv * dv), set1(1e-6f));
    }

    int width_, height_, pitch_, samples_ = 0;
    std::vector<float> grey_;  // with REACH repeated pixels around it
    Offset offsets_[SAMPLES];
    const std::vector<Warp> &warps_;
    const std::vector<const GreyImage *> &images_;
    float fx_, fy_, cx_, cy_, low_, high_;
    PlaneMaps maps_;
};

}  // namespace ms
