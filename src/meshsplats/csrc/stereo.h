// Depths of photographs by matching each with a few others: coarse to fine, a plane sweep at half the size,
// then slanted windows at the whole.
#pragma once

#include "patchmatch.h"
#include "plane_sweep.h"

extern "C" {

struct MsMatching {
    MsViews photos;
    const uint8_t *color;    // (pixels, 3) display RGB
    MsViews matched;         // those whose depths are wanted, with the pixels of their results
    const int32_t *photo;    // (matched.count) which of the photos each is
    const int32_t *sources;  // (matched.count, source_count) photos that it is matched with; negative: none
    const float *range;      // (matched.count, 2) least and greatest inverse depth
    float *inverse, *along_x, *along_y,
        *score;  // results, (pixels of matched): planes, and how well they fit
    int32_t source_count, planes, rounds;
};

}  // extern "C"

namespace ms {

class Matching {
  public:
    explicit Matching(const MsMatching &input) : input_(input) {
        for (int i = 0; i < input.matched.count; ++i) {
            check_photo(input.photo[i]);
            for (int k = 0; k < input.source_count; ++k)
                if (source(i, k) >= 0) check_photo(source(i, k));
        }
    }

    void run() {
        const MsViews &all = input_.photos;
        photos_.resize(all.count);
        parallel_blocks(all.threads, all.count, 1, [&](int64_t i, int64_t, int) {
            photos_[i] =
                GreyPhoto(input_.color + 3 * all.start[i], all.cameras[i].width, all.cameras[i].height);
        });
        parallel_blocks(all.threads, input_.matched.count, 1,
                        [&](int64_t i, int64_t, int) { match((int)i); });
    }

  private:
    int source(int view, int k) const { return input_.sources[(int64_t)view * input_.source_count + k]; }

    void check_photo(int photo) const {
        if (photo < 0 || photo >= input_.photos.count)
            throw std::invalid_argument("photograph " + std::to_string(photo) + " of " +
                                        std::to_string(input_.photos.count));
    }

    void match(int view) {
        const int own = input_.photo[view];
        const MsCamera &camera = input_.photos.cameras[own];
        const int width = camera.width, height = camera.height;
        const int64_t start = input_.matched.start[view];
        const PlaneMaps maps{input_.inverse + start, input_.along_x + start, input_.along_y + start,
                             input_.score + start};
        const float low = input_.range[2 * view], high = input_.range[2 * view + 1];
        std::vector<Warp> warps[2];
        std::vector<const GreyImage *> images[2];
        for (int k = 0; k < input_.source_count; ++k)
            if (const int other = source(view, k); other >= 0)
                for (int level = 0; level < 2; ++level) {
                    warps[level].emplace_back(camera, input_.photos.cameras[other], level);
                    images[level].push_back(&photos_[other].level[level]);
                }
        if (warps[0].empty()) {
            std::fill_n(maps.inverse, (size_t)width * height, low);
            for (float *slopes : {maps.along_x, maps.along_y})
                std::fill_n(slopes, (size_t)width * height, 0.0f);
            std::fill_n(maps.score, (size_t)width * height, BestTwo::UNSEEN);
            return;
        }
        const GreyPhoto &photo = photos_[own];
        const GreyImage &half = photo.level[1];
        const size_t coarse_size = (size_t)half.width * half.height;
        std::vector<float> coarse(4 * coarse_size);
        float *inverse = coarse.data(), *along_x = inverse + coarse_size, *along_y = along_x + coarse_size;
        float *score = along_y + coarse_size;
        PlaneSweep(half).run(warps[1], images[1], input_.planes, low, high, inverse, score);
        fit_slopes(half.width, half.height, inverse, (high - low) / (float)(input_.planes - 1), along_x,
                   along_y);
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const size_t i = (size_t)y * width + x, from = (size_t)(y / 2) * half.width + x / 2;
                const float dx = x % 2 ? 0.25f : -0.25f, dy = y % 2 ? 0.25f : -0.25f;
                maps.inverse[i] = inverse[from] + dx * along_x[from] + dy * along_y[from];
                maps.along_x[i] = 0.5f * along_x[from], maps.along_y[i] = 0.5f * along_y[from];
                maps.score[i] = score[from];
            }
        if (input_.rounds < 0) return;
        PatchMatch(photo.level[0], camera, warps[0], images[0], low, high, maps).run(input_.rounds);
    }

    const MsMatching &input_;
    std::vector<GreyPhoto> photos_;
};

}  // namespace ms
