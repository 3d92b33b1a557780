// The gradients of a loss with respect to the samples of one tile.
#pragma once

#include <algorithm>
#include <vector>

#include "tile_area.h"
#include "types.h"

namespace ms {

class SampleGradients {
  public:
    // `channels`: of the attributes with gradients.
    SampleGradients(const Grid &grid, const MsOptions &options, const MsCamera &camera,
                    const MsImageGradients &image_gradients, int channels)
        : grid_(grid),
          options_(options),
          camera_(camera),
          image_gradients_(image_gradients),
          channels_(channels),
          grad_attributes_((size_t)channels * MAX_SAMPLES) {}

    // Fills the gradients of the samples of a tile; false if all are 0.
    bool load(const TileArea &area) {
        const int s = grid_.samples;
        const float share = 1.0f / (s * s);
        bool any = false;
        const int samples = area.blocks * LANES;
        for (int c = 0; c < 3; ++c) std::fill(grad_color_[c], grad_color_[c] + samples, 0.0f);
        for (int c = 0; c < 3; ++c) std::fill(target_[c], target_[c] + samples, 0.0f);
        std::fill(expected_weight_, expected_weight_ + samples, 0.0f);
        std::fill(background_behind_, background_behind_ + samples, 0.0f);
        std::fill(grad_attributes_.begin(), grad_attributes_.end(), 0.0f);
        for (int y = 0; y < area.rows; ++y) {
            for (int x = 0; x < area.columns; ++x) {
                const int sample = TileArea::sample_index(x, y);
                const int64_t pixel = (int64_t)((area.y0 + y) / s) * camera_.width + (area.x0 + x) / s;
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                // Alpha is 1 - T_end: a colour channel that is 0 everywhere over a background of -1.
                float behind = image_gradients_.alpha ? -image_gradients_.alpha[pixel] * share : 0;
                any |= behind != 0;
                for (int c = 0; c < 3; ++c) {
                    const float g = image_gradients_.color[3 * pixel + c] * share;
                    grad_color_[c][sample] = g;
                    behind += g * background[c];
                    any |= g != 0;
                }
                const float expected =
                    image_gradients_.expected_weight ? image_gradients_.expected_weight[pixel] * share : 0;
                expected_weight_[sample] = expected;
                for (int c = 0; c < 3 && expected != 0; ++c) {
                    target_[c][sample] = image_gradients_.target[3 * pixel + c];
                    const float error = background[c] - target_[c][sample];
                    behind += expected * error * error;
                    any = true;
                }
                for (int c = 0; c < channels_; ++c) {
                    const float g = image_gradients_.attributes[pixel * channels_ + c] * share;
                    grad_attributes_[(size_t)c * MAX_SAMPLES + sample] = g;
                    any |= g != 0;
                }
                background_behind_[sample] = behind;
            }
        }
        return any;
    }

    // Of the samples of a block.
    Lanes color(int channel, int block) const { return load_lanes(grad_color_[channel] + block * LANES); }
    Lanes attribute(int channel, int block) const {
        return load_lanes(&grad_attributes_[(size_t)channel * MAX_SAMPLES + block * LANES]);
    }
    // B . g at the end, B the background.
    Lanes background_behind(int block) const { return load_lanes(background_behind_ + block * LANES); }
    // Of the expected loss, see MsImageGradients.
    bool any_expected() const { return image_gradients_.expected_weight; }
    Lanes expected_weight(int block) const { return load_lanes(expected_weight_ + block * LANES); }
    Lanes target(int channel, int block) const { return load_lanes(target_[channel] + block * LANES); }

  private:
    const Grid &grid_;
    const MsOptions &options_;
    const MsCamera &camera_;
    const MsImageGradients &image_gradients_;
    const int channels_;
    alignas(64) float grad_color_[3][MAX_SAMPLES];
    alignas(64) float background_behind_[MAX_SAMPLES];
    alignas(64) float target_[3][MAX_SAMPLES];
    alignas(64) float expected_weight_[MAX_SAMPLES];  // 0 without one
    std::vector<float> grad_attributes_;              // (channel, sample)
};

}  // namespace ms
