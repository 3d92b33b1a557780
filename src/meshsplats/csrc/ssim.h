// Sums of |x - y| and of SSIM (Wang et al. 2004) over two batches of images x and y, and the gradient with
// respect to x. SSIM takes most of the time and is skipped if its rate is 0.
//
// Windows are 11 x 11 Gaussians of sigma 1.5 around each pixel; values outside the image and where the mask
// is 0 are 0. With m = (x + y) / 2, d = x - y and G the windowed mean, the usual quotient of SSIM is
//     (1 - p^2 / B1) (1 - v / B2),  p = G d,         B1 = 2 (G m)^2 + p^2 / 2 + C1,
//                                   v = G d^2 - p^2, B2 = 2 (G m^2 - (G m)^2) + v / 2 + C2.
// In this form rounding is relative to 1 - SSIM, and four filtered fields are enough. B2 does not change if a
// constant is subtracted from m; subtracting 1/2 keeps two more bits of the variance in bright regions.
//
// The window is separable. A tile is swept once from top to bottom: rows are filtered horizontally into a
// ring of 11 rows and the ring is filtered vertically. The derivatives pass through a second ring in the same
// way.
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
    const float *image, *target;  // (count, height, width, channels)
    const uint8_t *mask;          // (count, height, width), 0: does not count; or null
    float *gradient;  // out: of l1_weight * l1 + ssim_weight * ssim, shaped like the images; or null
    float l1_weight, ssim_weight;
    double l1, ssim;  // out: sums over channels and pixels that count
};

}  // extern "C"

namespace ms {

// Compares one tile at a time. A row of a tile holds the channels of its pixels side by side, so that vectors
// need not know about channels. Rows have up to three sizes: the tile itself, with a margin of RADIUS pixels
// on both sides (where windows of the tile's derivatives are centred), and with a margin of 2 RADIUS (what
// these windows reach).
class ComparisonTile {
  public:
    static constexpr int RADIUS = 5, TAPS = 2 * RADIUS + 1;
    static constexpr int MAX_ROWS = 128, MAX_VALUES = 384;  // size of a tile: rows, and values per row
    static constexpr float C1 = 1e-4f, C2 = 9e-4f;

    explicit ComparisonTile(const MsComparison &comparison)
        : comparison_(comparison), channels_(comparison.channels) {
        constexpr double SIGMA = 1.5;
        double weight[RADIUS + 1], total = 0;
        for (int k = 0; k <= RADIUS; ++k) {
            weight[k] = std::exp(-k * k / (2 * SIGMA * SIGMA));
            total += k ? 2 * weight[k] : weight[k];
        }
        for (int k = 0; k <= RADIUS; ++k) weight_[k] = (float)(weight[k] / total);

        set_sizes(std::max<int64_t>(MAX_VALUES, channels_));
        for (auto *row :
             {&x_, &y_, &m_, &d_, &mm_, &dd_, &counts_, &derivative_[0], &derivative_[1], &derivative_[2]})
            row->assign(size2_, 0);
        ssim_.assign(size1_, 0);
        for (auto &row : ring_) row.assign(4 * size1_, 0);
        if (comparison.gradient)
            for (auto &row : derivative_ring_) row.assign(3 * size0_, 0);
    }

    // Adds |x - y| to sums[0] and SSIM to sums[1], for rows [top, bottom) and columns [left, right) of one
    // image.
    void compare(int64_t image, int top, int bottom, int left, int right, double *sums) {
        MS_ASSERT(image >= 0 && image < comparison_.count);
        MS_ASSERT(0 <= top && top < bottom && bottom <= comparison_.height && bottom - top <= MAX_ROWS);
        MS_ASSERT(0 <= left && left < right && right <= comparison_.width);
        image_ = image, left_ = left, right_ = right;
        length_ = (right - left) * channels_;
        set_sizes(length_);
        MS_ASSERT(size2_ <= (int64_t)x_.size());
        if (comparison_.ssim_weight == 0)
            compare_l1(top, bottom, sums);
        else
            compare_l1_and_ssim(top, bottom, sums);
    }

  private:
    // A sum whose order does not depend on the vector width.
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
    static float absolute(float d) { return std::fabs(d); }
    static float identity(float s) { return s; }

    // Whole vectors: rows may be written beyond their length.
    static int64_t padded(int64_t n) { return (n + 15) / 16 * 16; }
    void set_sizes(int64_t length) {
        const int64_t margins = 2 * RADIUS * channels_;
        size0_ = padded(length), size1_ = padded(length + margins), size2_ = padded(size1_ + margins);
    }

    void compare_l1(int top, int bottom, double *sums) {
        Sum l1;
        for (int row = top; row < bottom; ++row) {
            read(row, 0);
            for (int64_t i = 0; i < size0_; i += W) store(&d_[i], load(&x_[i]) - load(&y_[i]));
            l1.add(&d_[0], length_, absolute);
            if (comparison_.gradient) write_gradient(row, false);
        }
        sums[0] += l1.total();
    }

    void compare_l1_and_ssim(int top, int bottom, double *sums) {
        Sum l1, ssim;
        const int reach = comparison_.gradient ? 2 * RADIUS : RADIUS;
        for (int row = top - reach; row < bottom + reach; ++row) {
            load_fields(row);
            if (row >= top && row < bottom) l1.add(&d_[2 * RADIUS * channels_], length_, absolute);
            filter_fields(row);
            // The ring holds the rows around this one.
            const int center = row - RADIUS;
            if (center < top - reach + RADIUS) continue;
            compute_ssim(center);
            if (center >= top && center < bottom) ssim.add(&ssim_[RADIUS * channels_], length_, identity);
            if (comparison_.gradient) {
                filter_derivatives(center);
                if (center - RADIUS < top) continue;
                read(center - RADIUS, 0);
                write_gradient(center - RADIUS, true);
            }
        }
        sums[0] += l1.total();
        sums[1] += ssim.total();
    }

    // m, d and their squares for a row, with margins of 2 RADIUS.
    void load_fields(int row) {
        read(row, 2 * RADIUS);
        for (int64_t i = 0; i < size2_; i += W) {
            const vf x = load(&x_[i]), y = load(&y_[i]);
            const vf m = (x + y) * set1(0.5f) - set1(0.5f), d = x - y;
            store(&m_[i], m);
            store(&d_[i], d);
            store(&mm_[i], m * m);
            store(&dd_[i], d * d);
        }
    }

    // x_, y_ and counts_ for a row with margins of `margin` pixels; 0 outside the image and the mask.
    void read(int row, int margin) {
        const int first = left_ - margin, last = right_ + margin;
        const int64_t used = (int64_t)(last - first) * channels_;
        if (row < 0 || row >= comparison_.height) {
            for (auto *r : {&x_, &y_, &counts_}) std::fill(r->begin(), r->begin() + used, 0.0f);
            return;
        }
        const int from = std::max(first, 0), to = std::min(last, comparison_.width);
        const int64_t before = (int64_t)(from - first) * channels_, within = (int64_t)(to - from) * channels_;
        const int64_t pixel = (image_ * comparison_.height + row) * comparison_.width + from;
        std::memcpy(&x_[before], comparison_.image + pixel * channels_, within * sizeof(float));
        std::memcpy(&y_[before], comparison_.target + pixel * channels_, within * sizeof(float));
        std::fill_n(&counts_[before], within, 1.0f);
        for (auto *r : {&x_, &y_, &counts_}) {
            std::fill(r->begin(), r->begin() + before, 0.0f);
            std::fill(r->begin() + before + within, r->begin() + used, 0.0f);
        }
        if (!comparison_.mask) return;
        for (int i = 0; i < to - from; ++i)
            if (!comparison_.mask[pixel + i])
                for (auto *r : {&x_, &y_, &counts_})
                    std::fill_n(&(*r)[before + (int64_t)i * channels_], channels_, 0.0f);
    }

    // counts_ alone, with margins of RADIUS.
    void read_counts(int row) {
        std::fill(counts_.begin(), counts_.begin() + size1_, 0.0f);
        if (row < 0 || row >= comparison_.height) return;
        const int from = std::max(left_ - RADIUS, 0), to = std::min(right_ + RADIUS, comparison_.width);
        float *out = &counts_[(int64_t)(from - (left_ - RADIUS)) * channels_];
        if (!comparison_.mask) {
            std::fill_n(out, (int64_t)(to - from) * channels_, 1.0f);
            return;
        }
        const uint8_t *mask =
            comparison_.mask + (image_ * comparison_.height + row) * comparison_.width + from;
        for (int i = 0; i < to - from; ++i)
            std::fill_n(out + (int64_t)i * channels_, channels_, mask[i] ? 1.0f : 0.0f);
    }

    // Filters along a row (stride: channels) ...
    vf filter(const float *middle, int64_t stride) const {
        vf sum = set1(weight_[0]) * load(middle);
        for (int k = 1; k <= RADIUS; ++k)
            sum += set1(weight_[k]) * (load(middle - k * stride) + load(middle + k * stride));
        return sum;
    }
    // ... or across TAPS rows.
    vf filter(const float *const *rows, int64_t i) const {
        vf sum = set1(weight_[0]) * load(rows[RADIUS] + i);
        for (int k = 1; k <= RADIUS; ++k)
            sum += set1(weight_[k]) * (load(rows[RADIUS - k] + i) + load(rows[RADIUS + k] + i));
        return sum;
    }
    // The slot of an image row in a ring. Rows begin at -2 RADIUS.
    template <class Row>
    static auto ring_row(Row *ring, int row) {
        MS_ASSERT(row >= -4 * TAPS);
        return ring[(row + 4 * TAPS) % TAPS].data();
    }
    template <class Row>
    static void window_rows(Row *ring, int center, const float **rows) {
        for (int k = 0; k < TAPS; ++k) rows[k] = ring_row(ring, center - RADIUS + k);
    }

    // Filters the four fields horizontally into the ring.
    void filter_fields(int row) {
        float *out = ring_row(ring_, row);
        for (const auto *field : {&m_, &d_, &mm_, &dd_}) {
            const float *middle = field->data() + RADIUS * channels_;
            for (int64_t i = 0; i < size1_; i += W) store(out + i, filter(middle + i, channels_));
            out += size1_;
        }
    }

    // SSIM of the windows centred in a row, with margins of RADIUS, and its derivatives with respect to x
    // through p and G m (together), G d^2 and G m^2.
    void compute_ssim(int row) {
        const float *rows[TAPS];
        window_rows(ring_, row, rows);
        read_counts(row);
        const vf one = set1(1), two = set1(2), half = set1(0.5f), c1 = set1(C1), c2 = set1(C2);
        for (int64_t i = 0; i < size1_; i += W) {
            const vf mean = filter(rows, i), p = filter(rows, i + size1_);
            const vf mean_square = filter(rows, i + 2 * size1_), square = filter(rows, i + 3 * size1_);
            const vf counts = load(&counts_[i]);
            const vf q = mean + half, pp = p * p;  // q = G m, without the subtracted 1/2
            const vf v = vmax(square - pp, vf{}), w = vmax(mean_square - mean * mean, vf{});
            const vf b1 = two * q * q + half * pp + c1, b2_of_m = two * w + c2, b2 = b2_of_m + half * v;
            const vf i1 = one / b1, i2 = one / b2;
            const vf luminance = one - pp * i1, contrast = one - v * i2;
            store(&ssim_[i], luminance * contrast * counts);
            if (!comparison_.gradient) continue;
            const vf k = luminance * i2 * i2 * counts, by_square = -(k * b2_of_m),
                     by_mean_square = two * k * v;
            const vf l = contrast * i1 * counts;
            const vf by_p = l * p * (pp * i1 - two) - two * p * by_square;
            const vf by_mean = set1(4) * l * pp * q * i1 - two * mean * by_mean_square;
            store(&derivative_[0][i], by_p + half * by_mean);
            store(&derivative_[1][i], by_square);
            store(&derivative_[2][i], by_mean_square);
        }
    }

    // Filters the derivatives horizontally into their ring.
    void filter_derivatives(int row) {
        float *out = ring_row(derivative_ring_, row);
        for (const auto &field : derivative_) {
            const float *middle = field.data() + RADIUS * channels_;
            for (int64_t i = 0; i < size0_; i += W) store(out + i, filter(middle + i, channels_));
            out += size0_;
        }
    }

    // Writes the gradient of a row, whose x_, y_ and counts_ are loaded without margins.
    void write_gradient(int row, bool with_ssim) {
        const float *rows[TAPS];
        if (with_ssim) window_rows(derivative_ring_, row, rows);
        float *out = comparison_.gradient +
                     ((image_ * comparison_.height + row) * comparison_.width + left_) * (int64_t)channels_;
        typedef int vi __attribute__((vector_size(4 * W)));
        const vf ssim_weight = set1(comparison_.ssim_weight), two = set1(2), half = set1(0.5f);
        const vi l1_weight = (vi)set1(comparison_.l1_weight);
        for (int64_t i = 0; i < length_; i += W) {
            const vf x = load(&x_[i]), y = load(&y_[i]), d = x - y, m = (x + y) * half - half;
            // l1_weight * sign(d)
            vf sum = (vf)((vi)(d > vf{}) & l1_weight) - (vf)((vi)(d < vf{}) & l1_weight);
            if (with_ssim)
                sum += ssim_weight * (filter(rows, i) + two * d * filter(rows, i + size0_) +
                                      m * filter(rows, i + 2 * size0_));
            sum *= load(&counts_[i]);
            if (i + W <= length_)
                store(out + i, sum);
            else
                std::memcpy(out + i, &sum, (length_ - i) * sizeof(float));
        }
    }

    const MsComparison &comparison_;
    const int64_t channels_;
    float weight_[RADIUS + 1];
    int64_t size0_, size1_, size2_;  // padded row sizes with margins of 0, 1 and 2 RADIUS
    int64_t image_ = 0, length_ = 0;
    int left_ = 0, right_ = 0;
    // Rows: the images; m, d and their squares; 1 for pixels that count, else 0; SSIM and its derivatives.
    std::vector<float> x_, y_, m_, d_, mm_, dd_, counts_, ssim_, derivative_[3];
    // Horizontally filtered fields, one after another in each row: 4 of size1_, 3 of size0_.
    std::vector<float> ring_[TAPS], derivative_ring_[TAPS];
};

// Fills the sums and the gradient. The tiles and the order of summation do not depend on the number of
// threads.
inline void compare_images(MsComparison &comparison) {
    MS_ASSERT(comparison.count >= 0 && comparison.height >= 1 && comparison.width >= 1);
    MS_ASSERT(comparison.channels >= 1 && comparison.threads >= 1);
    // Tiles of about equal size.
    const int max_columns = std::max(1, ComparisonTile::MAX_VALUES / comparison.channels);
    const int tiles_x = (comparison.width + max_columns - 1) / max_columns,
              columns = (comparison.width + tiles_x - 1) / tiles_x;
    const int tiles_y = (comparison.height + ComparisonTile::MAX_ROWS - 1) / ComparisonTile::MAX_ROWS,
              rows = (comparison.height + tiles_y - 1) / tiles_y;
    const int64_t tiles = comparison.count * tiles_x * tiles_y;
    std::vector<double> sums(2 * tiles, 0);
    std::vector<std::unique_ptr<ComparisonTile>> workers(comparison.threads);
    parallel_blocks(comparison.threads, tiles, 1, [&](int64_t tile, int64_t, int thread) {
        if (!workers[thread]) workers[thread] = std::make_unique<ComparisonTile>(comparison);
        const int64_t image = tile / tiles_x / tiles_y;
        const int top = (int)(tile / tiles_x % tiles_y) * rows, left = (int)(tile % tiles_x) * columns;
        workers[thread]->compare(image, top, std::min(top + rows, comparison.height), left,
                                 std::min(left + columns, comparison.width), &sums[2 * tile]);
    });
    comparison.l1 = comparison.ssim = 0;
    for (int64_t tile = 0; tile < tiles; ++tile)
        comparison.l1 += sums[2 * tile], comparison.ssim += sums[2 * tile + 1];
}

}  // namespace ms
