// Large clouds of splats are drawn in stages, nearest first: what lies behind finished tiles is not
// projected.
//
// The image is that of all splats at once, to the last bit: a tile is finished when all its samples have
// stopped, and others go on in the next stage.
#pragma once

#include <algorithm>
#include <functional>
#include <vector>

#include "grid.h"
#include "triangle.h"

namespace ms {

// The tiles of an image that are not finished.
class OpenTiles {
  public:
    explicit OpenTiles(const Grid &grid) : grid_(grid), open_(grid.tiles(), 1) {}

    bool is_open(int64_t tile) const { return open_[tile]; }
    // Threads may close different tiles at the same time; count() lets any() know.
    void close(int64_t tile) { open_[tile] = 0; }

    void count() {
        const int w = grid_.tiles_x + 1;
        sums_.assign((size_t)w * (grid_.tiles_y + 1), 0);
        for (int y = 0; y < grid_.tiles_y; ++y) {
            int32_t sum = 0;
            for (int x = 0; x < grid_.tiles_x; ++x) {
                sum += open_[grid_.tile_index(x, y)];
                sums_[(size_t)(y + 1) * w + x + 1] = sum + sums_[(size_t)y * w + x + 1];
            }
        }
    }
    // Whether any tile of an inclusive range was open when they were last counted.
    bool any(int x0, int x1, int y0, int y1) const {
        if (sums_.empty()) return true;
        const size_t w = grid_.tiles_x + 1, above = w * y0, below = w * (y1 + 1);
        return sums_[below + x1 + 1] - sums_[below + x0] > sums_[above + x1 + 1] - sums_[above + x0];
    }

  private:
    const Grid &grid_;
    std::vector<uint8_t> open_;  // by tile
    std::vector<int32_t> sums_;  // open tiles left of each column and above each row; empty: all are open
};

// Which stage a splat belongs to, by its key: 1 / depth of its centre.
class SplatStages {
  public:
    SplatStages(const MsSplats &cloud, const Projection &projection, const Grid &grid) {
        if (grid.tiles() > MOST_TILES) return;
        const int64_t every = std::max<int64_t>(1, cloud.count / SAMPLE);
        std::vector<float> keys;  // of some splats, of those with their centres in the image
        for (int64_t i = 0; i < cloud.count; i += every) {
            const Vec3 c = projection.to_camera(cloud.means + 3 * i);
            if (!(c.z >= projection.near)) continue;
            const Projected p = projection.project(c);
            if (p.x >= 0 && p.x < grid.width && p.y >= 0 && p.y < grid.height) keys.push_back((float)p.w);
        }
        std::sort(keys.begin(), keys.end(), std::greater<float>());
        const int64_t count = (int64_t)keys.size() * every;
        for (int64_t splats = FIRST; splats * LEAST_GROWTH <= count; splats *= GROWTH)
            ends_.push_back(keys[splats / every]);
    }

    int count() const { return (int)ends_.size() + 1; }
    int of(float key) const {
        int stage = 0;
        while (stage < (int)ends_.size() && !(key > ends_[stage])) ++stage;
        return stage;
    }

  private:
    static constexpr int64_t MOST_TILES = 1 << 16;  // of images in stages: 256 MB for tiles that go on
    static constexpr int64_t SAMPLE = 20'000;
    static constexpr int64_t FIRST = 150'000;  // splats up to the end of the first stage
    // Up to the end of each other stage there are this many times as many, of the last one at least so many.
    static constexpr int64_t GROWTH = 2, LEAST_GROWTH = 2;

    std::vector<float> ends_;  // of all stages but the last: greater keys belong to the stage
};

}  // namespace ms
