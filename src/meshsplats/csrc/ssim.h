// Sums of |x - y| and of SSIM (Wang et al. 2004) over two sets of pictures, and the gradient with respect to
// x. SSIM costs most of the time and is left out where its rate is 0.
//
// Windows are 11 x 11 Gaussians, sigma 1.5, one a pixel; outside the picture, and where the mask is 0, are
// zeros. With m = (x + y) / 2, d = x - y and G the window's mean, the usual quotient of SSIM is
//     (1 - p^2 / B1) (1 - v / B2),  p = G d,        B1 = 2 (G m)^2 + p^2 / 2 + C1,
//                                   v = G d^2 - p^2, B2 = 2 (G m^2 - (G m)^2) + v / 2 + C2.
// In this form rounding is relative to 1 - SSIM, and four filtered rows are enough. B2 does not change when a
// constant is taken from m; taking 1/2 keeps four times as many digits of the variance in bright parts.
//
// The window is separable. A tile goes down its rows once: rows are filtered across into a ring of 11, the
// ring is filtered down, and the derivatives that come out go the same way through a second ring.
#pragma once

#include <cmath>
#include <cstring>
#include <memory>

#include "parallel.h"
#include "simd.h"

extern "C" {

struct MsComparison {
    int64_t count;
    int32_t height, width, channels;
    int32_t threads;
    const float *picture, *truth;  // (count, height, width, channels)
    const uint8_t *mask;           // (count, height, width), 0: outside; or null
    float *gradient;               // of l1_rate * l1 + ssim_rate * ssim, like the pictures; or null
    float l1_rate, ssim_rate;
    double l1, ssim;  // out: sums over channels and pixels inside
};

}  // extern "C"

namespace ms {

class ComparisonTile {
  public:
    static constexpr int RADIUS = 5, TAPS = 2 * RADIUS + 1;
    static constexpr int ROWS = 128,
                         VALUES = 384;  // of a tile, at most; VALUES across, all channels of a pixel
    static constexpr float C1 = 1e-4f, C2 = 9e-4f;

    explicit ComparisonTile(const MsComparison &all) : all_(all), step_(all.channels) {
        double weight[RADIUS + 1], total = 0;
        for (int k = 0; k <= RADIUS; ++k) {
            weight[k] = std::exp(-k * k / (2 * 1.5 * 1.5));
            total += k ? 2 * weight[k] : weight[k];
        }
        for (int k = 0; k <= RADIUS; ++k) weight_[k] = (float)(weight[k] / total);

        const int64_t margin = 2 * RADIUS * step_, inner = whole(std::max<int64_t>(VALUES, step_));
        const int64_t middle = whole(inner + margin), outer = whole(middle + margin);
        for (auto *row : {&x_, &y_, &m_, &d_, &mm_, &dd_, &inside_, &slope_[0], &slope_[1], &slope_[2]})
            row->assign(outer, 0);
        value_.assign(middle, 0);
        for (auto &row : ring_) row.assign(4 * middle, 0);
        if (all.gradient)
            for (auto &row : slope_ring_) row.assign(3 * inner, 0);
    }

    // Adds to sums[0] |x - y| and to sums[1] SSIM, for rows [top, bottom) and columns [left, right) of a
    // picture.
    void run(int64_t number, int top, int bottom, int left, int right, double *sums) {
        number_ = number, left_ = left, right_ = right;
        length_ = (right - left) * step_;
        inner_ = whole(length_), middle_ = whole(length_ + 2 * RADIUS * step_);
        outer_ = whole(middle_ + 2 * RADIUS * step_);
        Sum l1, ssim;
        if (all_.ssim_rate == 0) {
            for (int row = top; row < bottom; ++row) {
                read(row, 0);
                for (int64_t i = 0; i < inner_; i += W) store(&d_[i], load(&x_[i]) - load(&y_[i]));
                l1.add(&d_[0], length_, [](float d) { return std::fabs(d); });
                if (all_.gradient) write_gradient(row, false);
            }
            sums[0] += l1.total();
            return;
        }
        const int reach = all_.gradient ? 2 * RADIUS : RADIUS;
        for (int row = top - reach; row < bottom + reach; ++row) {
            load_row(row);
            if (row >= top && row < bottom)
                l1.add(&d_[2 * RADIUS * step_], length_, [](float d) { return std::fabs(d); });
            filter_row(row);
            const int center = row - RADIUS;
            if (center < top - reach + RADIUS) continue;
            compare(center);
            if (center >= top && center < bottom)
                ssim.add(&value_[RADIUS * step_], length_, [](float s) { return s; });
            if (all_.gradient) {
                filter_slopes(center);
                if (center - RADIUS < top) continue;
                read(center - RADIUS, 0);
                write_gradient(center - RADIUS, true);
            }
        }
        sums[0] += l1.total();
        sums[1] += ssim.total();
    }

  private:
    // One order of summation for every vector width.
    struct Sum {
        double part[16] = {};
        template <class Term>
        void add(const float *row, int64_t length, Term term) {
            int64_t i = 0;
            for (; i + 16 <= length; i += 16)
                for (int j = 0; j < 16; ++j) part[j] += term(row[i + j]);
            for (; i < length; ++i) part[i & 15] += term(row[i]);
        }
        double total() const {
            double sum = 0;
            for (double p : part) sum += p;
            return sum;
        }
    };

    static int64_t whole(int64_t n) { return (n + 15) / 16 * 16; }

    // Row of the picture, from 10 columns left of the tile to 10 right of it: m, d and their squares.
    void load_row(int row) {
        read(row, 2 * RADIUS);
        for (int64_t i = 0; i < outer_; i += W) {
            const vf x = load(&x_[i]), y = load(&y_[i]);
            const vf m = (x + y) * set1(0.5f) - set1(0.5f), d = x - y;
            store(&m_[i], m);
            store(&d_[i], d);
            store(&mm_[i], m * m);
            store(&dd_[i], d * d);
        }
    }

    // x_, y_ and inside_ from `margin` columns left of the tile to `margin` right of it.
    void read(int row, int margin) {
        const int first = left_ - margin, last = right_ + margin;
        const int64_t used = (int64_t)(last - first) * step_;
        if (row < 0 || row >= all_.height) {
            for (auto *r : {&x_, &y_, &inside_}) std::fill(r->begin(), r->begin() + used, 0.0f);
            return;
        }
        const int from = std::max(first, 0), to = std::min(last, all_.width);
        const int64_t before = (int64_t)(from - first) * step_, within = (int64_t)(to - from) * step_;
        const int64_t pixel = (number_ * all_.height + row) * all_.width + from;
        std::memcpy(&x_[before], all_.picture + pixel * step_, within * sizeof(float));
        std::memcpy(&y_[before], all_.truth + pixel * step_, within * sizeof(float));
        std::fill_n(&inside_[before], within, 1.0f);
        for (auto *r : {&x_, &y_, &inside_}) {
            std::fill(r->begin(), r->begin() + before, 0.0f);
            std::fill(r->begin() + before + within, r->begin() + used, 0.0f);
        }
        if (!all_.mask) return;
        for (int i = 0; i < to - from; ++i)
            if (!all_.mask[pixel + i])
                for (auto *r : {&x_, &y_, &inside_})
                    std::fill_n(&(*r)[before + (int64_t)i * step_], step_, 0.0f);
    }

    vf filter(const float *middle, int64_t stride) const {
        vf sum = set1(weight_[0]) * load(middle);
        for (int k = 1; k <= RADIUS; ++k)
            sum += set1(weight_[k]) * (load(middle - k * stride) + load(middle + k * stride));
        return sum;
    }
    vf filter(const float *const *rows, int64_t i) const {
        vf sum = set1(weight_[0]) * load(rows[RADIUS] + i);
        for (int k = 1; k <= RADIUS; ++k)
            sum += set1(weight_[k]) * (load(rows[RADIUS - k] + i) + load(rows[RADIUS + k] + i));
        return sum;
    }
    template <class Row>
    static auto slot(Row *ring, int row) {
        return ring[(row + 4 * TAPS) % TAPS].data();
    }
    template <class Row>
    static void ordered(Row *ring, int center, const float **rows) {
        for (int k = 0; k < TAPS; ++k) rows[k] = slot(ring, center - RADIUS + k);
    }

    void filter_row(int row) {
        float *out = slot(ring_, row);
        for (const auto *field : {&m_, &d_, &mm_, &dd_}) {
            const float *middle = field->data() + RADIUS * step_;
            for (int64_t i = 0; i < middle_; i += W) store(out + i, filter(middle + i, step_));
            out += middle_;
        }
    }

    // SSIM of the windows in a row, from 5 columns left of the tile to 5 right of it, and its derivatives
    // with respect to p and G m (together, as they reach x), G d^2 and G m^2.
    void compare(int row) {
        const float *rows[TAPS];
        ordered(ring_, row, rows);
        read_inside(row);
        const vf one = set1(1), two = set1(2), half = set1(0.5f), c1 = set1(C1), c2 = set1(C2);
        for (int64_t i = 0; i < middle_; i += W) {
            const vf mean = filter(rows, i), p = filter(rows, i + middle_);
            const vf mean_square = filter(rows, i + 2 * middle_), square = filter(rows, i + 3 * middle_);
            const vf inside = load(&inside_[i]);
            const vf q = mean + half, pp = p * p;
            const vf v = vmax(square - pp, vf{}), w = vmax(mean_square - mean * mean, vf{});
            const vf b1 = two * q * q + half * pp + c1, plain = two * w + c2, b2 = plain + half * v;
            const vf i1 = one / b1, i2 = one / b2;
            const vf luminance = one - pp * i1, contrast = one - v * i2;
            store(&value_[i], luminance * contrast * inside);
            if (!all_.gradient) continue;
            const vf k = luminance * i2 * i2 * inside, to_square = -(k * plain), to_mean_square = two * k * v;
            const vf l = contrast * i1 * inside;
            const vf to_p = l * p * (pp * i1 - two) - two * p * to_square;
            const vf to_mean = set1(4) * l * pp * q * i1 - two * mean * to_mean_square;
            store(&slope_[0][i], to_p + half * to_mean);
            store(&slope_[1][i], to_square);
            store(&slope_[2][i], to_mean_square);
        }
    }

    // inside_ alone, from 5 columns left of the tile to 5 right of it.
    void read_inside(int row) {
        std::fill(inside_.begin(), inside_.begin() + middle_, 0.0f);
        if (row < 0 || row >= all_.height) return;
        const int from = std::max(left_ - RADIUS, 0), to = std::min(right_ + RADIUS, all_.width);
        float *out = &inside_[(int64_t)(from - (left_ - RADIUS)) * step_];
        if (!all_.mask) {
            std::fill_n(out, (int64_t)(to - from) * step_, 1.0f);
            return;
        }
        const uint8_t *mask = all_.mask + (number_ * all_.height + row) * all_.width + from;
        for (int i = 0; i < to - from; ++i)
            std::fill_n(out + (int64_t)i * step_, step_, mask[i] ? 1.0f : 0.0f);
    }

    void filter_slopes(int row) {
        float *out = slot(slope_ring_, row);
        for (const auto &field : slope_) {
            const float *middle = field.data() + RADIUS * step_;
            for (int64_t i = 0; i < inner_; i += W) store(out + i, filter(middle + i, step_));
            out += inner_;
        }
    }

    // From x_, y_ and inside_ of the row, without margins.
    void write_gradient(int row, bool with_ssim) {
        const float *rows[TAPS];
        if (with_ssim) ordered(slope_ring_, row, rows);
        float *out = all_.gradient + ((number_ * all_.height + row) * all_.width + left_) * (int64_t)step_;
        typedef int vi __attribute__((vector_size(4 * W)));
        const vf rate = set1(all_.ssim_rate), two = set1(2), half = set1(0.5f);
        const vi l1 = (vi)set1(all_.l1_rate);
        for (int64_t i = 0; i < length_; i += W) {
            const vf x = load(&x_[i]), y = load(&y_[i]), d = x - y, m = (x + y) * half - half;
            vf sum = (vf)((vi)(d > vf{}) & l1) - (vf)((vi)(d < vf{}) & l1);
            if (with_ssim)
                sum += rate * (filter(rows, i) + two * d * filter(rows, i + inner_) +
                               m * filter(rows, i + 2 * inner_));
            sum *= load(&inside_[i]);
            if (i + W <= length_)
                store(out + i, sum);
            else
                std::memcpy(out + i, &sum, (length_ - i) * sizeof(float));
        }
    }

    const MsComparison &all_;
    const int64_t step_;  // values a pixel
    float weight_[RADIUS + 1];
    int64_t inner_, middle_, outer_;  // lengths of rows of the tile without, with one and with two margins
    int64_t number_ = 0, length_ = 0;
    int left_ = 0, right_ = 0;
    std::vector<float> x_, y_, m_, d_, mm_, dd_, inside_, value_, slope_[3];
    std::vector<float> ring_[TAPS], slope_ring_[TAPS];
};

// Fills the sums and the gradient. The tiles and the order of sums are the same for any number of threads.
inline void compare_pictures(MsComparison &all) {
    const int most = std::max(1, ComparisonTile::VALUES / all.channels);
    const int across = (all.width + most - 1) / most, wide = (all.width + across - 1) / across;
    const int down = (all.height + ComparisonTile::ROWS - 1) / ComparisonTile::ROWS;
    const int high = (all.height + down - 1) / down;
    const int64_t tiles = all.count * across * down;
    std::vector<double> sums(2 * tiles, 0);
    std::vector<std::unique_ptr<ComparisonTile>> workers(all.threads);
    parallel_blocks(all.threads, tiles, 1, [&](int64_t tile, int64_t, int thread) {
        if (!workers[thread]) workers[thread] = std::make_unique<ComparisonTile>(all);
        const int64_t number = tile / across / down;
        const int top = (int)(tile / across % down) * high, left = (int)(tile % across) * wide;
        workers[thread]->run(number, top, std::min(top + high, all.height), left,
                             std::min(left + wide, all.width), &sums[2 * tile]);
    });
    all.l1 = all.ssim = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) all.l1 += sums[2 * tile], all.ssim += sums[2 * tile + 1];
}

}  // namespace ms
