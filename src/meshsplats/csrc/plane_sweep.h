// Plane sweep (Collins 1996): for each pixel the inverse depth at which its window and those of other
// photographs correlate best.
#pragma once

#include "parallel.h"
#include "photos.h"

namespace ms {

class PlaneSweep {
  public:
    explicit PlaneSweep(const GreyImage &grey)
        : width_(grey.width), height_(grey.height), pitch_((grey.width + W - 1) / W * W) {
        const size_t size = (size_t)pitch_ * height_;
        for (auto *values :
             {&own_, &mean_, &deviation_, &first_, &second_, &best_, &before_, &after_, &last_, &at_})
            values->resize(size);
        ring_.resize((size_t)3 * RING * pitch_);
        column_sums_.resize((size_t)3 * (pitch_ + 2 * PAD));
        for (int y = 0; y < height_; ++y)
            for (int x = 0; x < pitch_; ++x) own_[(size_t)y * pitch_ + x] = grey.at(x, y);
        over_windows([&](int y, int x) { return load(&own_[(size_t)y * pitch_ + x]); },
                     [&](size_t i, vf mean, vf squares, vf) {
                         store(&mean_[i], mean);
                         store(&deviation_[i], vsqrt(vmax(squares - mean * mean, set1(PLAIN))));
                     });
    }

    // Tries `planes` inverse depths from `low` to `high`; writes the best of each pixel and its score, both
    // (height, width).
    void run(const std::vector<Warp> &warps, const std::vector<const GreyImage *> &images, int planes,
             float low, float high, float *inverse, float *score) {
        MS_ASSERT(planes >= 2);
        const float step = (high - low) / (float)(planes - 1);
        for (auto *values : {&best_, &before_, &after_, &last_, &at_})
            std::fill(values->begin(), values->end(), -1.0f);
        for (int plane = 0; plane < planes; ++plane) {
            stop_point();
            for (auto *values : {&first_, &second_})
                std::fill(values->begin(), values->end(), BestTwo::UNSEEN);
            for (size_t i = 0; i < warps.size(); ++i)
                correlate(warps[i], *images[i], low + step * (float)plane);
            keep_best((float)plane);
        }
        for (int y = 0; y < height_; ++y)
            for (int x = 0; x < width_; ++x) {
                // The maximum of the parabola through the best score and those beside it.
                const size_t i = (size_t)y * pitch_ + x;
                const float bend = before_[i] - 2 * best_[i] + after_[i];
                const float shift = bend < -1e-6f ? 0.5f * (before_[i] - after_[i]) / bend : 0;
                inverse[y * width_ + x] =
                    low + step * (std::max(at_[i], 0.0f) + std::clamp(shift, -0.5f, 0.5f));
                score[y * width_ + x] = best_[i];
            }
    }

  private:
    static constexpr int REACH = 2;  // pixels of a window to each side
    static constexpr int RING = 8;   // rows that are kept: a power of 2, at least 2 REACH + 1
    static constexpr int PAD = 16;   // floats beside a row
    static constexpr float OUTSIDE =
        -1e4f;  // in place of a grey value: one makes the mean of a window negative

    // Calls found(index, mean, mean of squares, mean of products with the own image) for W pixels at a time,
    // over the windows of value(y, x). Rows and columns at the border are repeated.
    template <class Value, class Found>
    void over_windows(Value value, Found found) {
        constexpr float SHARE = 1.0f / ((2 * REACH + 1) * (2 * REACH + 1));
        const int sums_pitch = pitch_ + 2 * PAD;
        auto row = [&](int k, int y) { return &ring_[(size_t)(3 * (y & (RING - 1)) + k) * pitch_]; };
        int made = 0;
        for (int y = 0; y < height_; ++y) {
            for (; made <= std::min(y + REACH, height_ - 1); ++made)
                for (int x = 0; x < pitch_; x += W) {
                    const vf v = value(made, x);
                    store(row(0, made) + x, v);
                    store(row(1, made) + x, v * v);
                    store(row(2, made) + x, v * load(&own_[(size_t)made * pitch_ + x]));
                }
            for (int k = 0; k < 3; ++k) {
                const float *rows[2 * REACH + 1];
                for (int i = -REACH; i <= REACH; ++i)
                    rows[i + REACH] = row(k, std::clamp(y + i, 0, height_ - 1));
                float *sums = &column_sums_[(size_t)k * sums_pitch + PAD];
                for (int x = 0; x < pitch_; x += W) {
                    vf sum = load(rows[0] + x);
                    for (int i = 1; i <= 2 * REACH; ++i) sum += load(rows[i] + x);
                    store(sums + x, sum);
                }
                for (int i = 1; i <= REACH; ++i) sums[-i] = sums[0], sums[width_ - 1 + i] = sums[width_ - 1];
            }
            for (int x = 0; x < pitch_; x += W) {
                vf means[3];
                for (int k = 0; k < 3; ++k) {
                    const float *sums = &column_sums_[(size_t)k * sums_pitch + PAD + x];
                    vf sum = load(sums - REACH);
                    for (int i = 1 - REACH; i <= REACH; ++i) sum += load(sums + i);
                    means[k] = sum * SHARE;
                }
                found((size_t)y * pitch_ + x, means[0], means[1], means[2]);
            }
        }
    }

    void correlate(const Warp &warp, const GreyImage &image, float inverse) {
        vf lanes{};
        for (int i = 0; i < W; ++i) lanes[i] = (float)i + 0.5f;
        const vf q = set1(inverse);
        over_windows(
            [&](int y, int column) {
                const vf x = lanes + (float)column;
                const float middle = (float)y + 0.5f;
                const vf z = warp.row(2, x, middle, q), inverse_z = 1 / vmax(z, set1(1e-6f));
                const vf u = warp.row(0, x, middle, q) * inverse_z, v = warp.row(1, x, middle, q) * inverse_z;
                return select(in_image(warp, u, v, z), sample(image, u, v), set1(OUTSIDE));
            },
            [&](size_t i, vf mean, vf squares, vf products) {
                const vf deviation = vsqrt(vmax(squares - mean * mean, set1(PLAIN)));
                vf correlation = (products - mean * load(&mean_[i])) / (deviation * load(&deviation_[i]));
                correlation = select(greater_equal(mean, set1(-1)), correlation, set1(BestTwo::UNSEEN));
                BestTwo best{load(&first_[i]), load(&second_[i])};
                best.add(correlation);
                store(&first_[i], best.first);
                store(&second_[i], best.second);
            });
    }

    // Of each pixel the best score, and those of the planes before and after it.
    void keep_best(float plane) {
        for (size_t i = 0; i < own_.size(); i += W) {
            const vf score = BestTwo{load(&first_[i]), load(&second_[i])}.score();
            const vf best = load(&best_[i]), at = load(&at_[i]), last = load(&last_[i]);
            const vm better = greater(score, best), follows = equal(at, set1(plane - 1));
            store(&after_[i], select(better, set1(-1), select(follows, score, load(&after_[i]))));
            store(&before_[i], select(better, last, load(&before_[i])));
            store(&best_[i], select(better, score, best));
            store(&at_[i], select(better, set1(plane), at));
            store(&last_[i], score);
        }
    }

    int width_, height_, pitch_;
    std::vector<float> own_, mean_, deviation_;  // of the photograph, and of its windows
    std::vector<float> first_, second_;          // the two best correlations on this plane
    std::vector<float> best_, before_, after_, last_, at_;
    std::vector<float> ring_, column_sums_;
};

}  // namespace ms
