// The sample grid of an image, its tiles, and binning: a depth-ordered list of entries for each tile.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "pooled_vector.h"
#include "types.h"

namespace ms {

// Largest tile side in samples. Fixed, so that rounding does not depend on the vector width. Large tiles set
// up fewer triangles twice; the queues of fragments fit the cache with small ones.
constexpr int TILE = 16, LARGE_TILE = 32;

struct Grid {
    int samples;        // per pixel and axis
    int width, height;  // in samples
    int largest_side;   // of a tile: TILE or LARGE_TILE
    int tile_side;      // in samples: the largest multiple of `samples` up to it, so tiles hold whole pixels
    int tiles_x, tiles_y;  // number of tiles, at most 2^15 each

    Grid(const MsCamera &camera, int samples, int largest_side = TILE)
        : samples(samples),
          width(camera.width * samples),
          height(camera.height * samples),
          largest_side(largest_side),
          tile_side(largest_side / samples * samples),
          tiles_x((width + tile_side - 1) / tile_side),
          tiles_y((height + tile_side - 1) / tile_side) {
        MS_ASSERT(samples >= 1 && samples <= TILE);
        MS_ASSERT(width > 0 && width < 1 << 28 && height > 0 && height < 1 << 28);
        MS_ASSERT(tiles_x <= 1 << 15 && tiles_y <= 1 << 15);
    }
    int64_t tiles() const { return (int64_t)tiles_x * tiles_y; }

    // Column or row of the tile that holds a sample column or row: sample / tile_side by a multiplication,
    // because a division would dominate the cost of binning a small triangle.
    int tile_of(int sample) const {
        MS_ASSERT(sample >= 0 && sample < std::max(width, height));
        return (int)((uint64_t)sample * reciprocal_ >> 32);
    }

    // Tiles are indexed down and then across strips of STRIP rows: what one tile reads is still in the cache
    // for its neighbours in both directions.
    static constexpr int STRIP = 4;
    int64_t tile_index(int x, int y) const {
        MS_ASSERT(x >= 0 && x < tiles_x && y >= 0 && y < tiles_y);
        const int first = y / STRIP * STRIP;
        return (int64_t)first * tiles_x + (int64_t)x * std::min(STRIP, tiles_y - first) + (y - first);
    }
    // The inverse of tile_index.
    void tile_position(int64_t tile, int &x, int &y) const {
        MS_ASSERT(tile >= 0 && tile < tiles());
        const int first = (int)(tile / ((int64_t)STRIP * tiles_x)) * STRIP,
                  rows = std::min(STRIP, tiles_y - first);
        const int64_t rest = tile - (int64_t)first * tiles_x;
        x = (int)(rest / rows);
        y = first + (int)(rest % rows);
    }

  private:
    // 2^32 / tile_side, rounded up: tile_of is exact for samples below 2^28 and sides up to 32.
    uint64_t reciprocal_ = (UINT64_C(1) << 32) / tile_side + 1;
};

// An entry of a tile list: a group of consecutive triangles, or a splat.
struct TileEntry {
    float key;  // greater is nearer: see bound_group of Scene; of a splat, 1 / depth of its centre
    int32_t first, length;
};

// An entry with the inclusive range of tiles that it may touch.
struct BinItem {
    TileEntry entry;
    uint16_t x0, x1, y0, y1;
};

// First and last sample whose centre lies in [lo, hi], clamped to [0, count); false if there is none. The
// interval is widened by a slack, so that rounding of edge functions never finds a sample outside of it.
inline bool sample_range(double lo, double hi, int count, int &first, int &last) {
    constexpr double slack = 1e-3;
    double a = std::ceil(lo - 0.5 - slack), b = std::floor(hi - 0.5 + slack);
    if (!(b >= 0) || !(a <= count - 1) || !(a <= b)) return false;
    first = a > 0 ? (int)a : 0;
    last = b < count - 1 ? (int)b : count - 1;
    return true;
}

// Sorts items nearest first, by a stable LSD radix sort of the bits of their keys: floats >= 0 order like
// their bit patterns, and the complement turns the order around. Negative floats do so already.
inline void sort_items(std::vector<BinItem> &items) {
    struct Slot {
        uint32_t key, item;
    };
    MS_ASSERT(items.size() <= UINT32_MAX);
    std::vector<Slot> slots(items.size()), other(items.size());
    constexpr int PASSES = 3, BITS = 11, DIGITS = 1 << BITS;
    std::vector<uint32_t> start(PASSES * DIGITS);
    auto digit = [](uint32_t key, int pass) { return key >> (BITS * pass) & (DIGITS - 1); };
    for (size_t i = 0; i < items.size(); ++i) {
        const float value = items[i].entry.key + 0.0f;  // no -0
        MS_ASSERT(value == value);
        uint32_t key;
        std::memcpy(&key, &value, 4);
        key = key >> 31 ? key : ~key & 0x7fffffff;
        slots[i] = {key, (uint32_t)i};
        for (int pass = 0; pass < PASSES; ++pass) ++start[pass * DIGITS + digit(key, pass)];
    }
    for (int pass = 0; pass < PASSES; ++pass) {
        uint32_t sum = 0, *counts = &start[pass * DIGITS];
        for (int i = 0; i < DIGITS; ++i) {
            const uint32_t n = counts[i];
            counts[i] = sum;
            sum += n;
        }
        for (const Slot &slot : slots) other[counts[digit(slot.key, pass)]++] = slot;
        slots.swap(other);
    }
    std::vector<BinItem> sorted(items.size());
    for (size_t i = 0; i < items.size(); ++i) sorted[i] = items[slots[i].item];
    items.swap(sorted);
}

// Bins sorted items into tile lists that keep the order of the items. Only the lists of a range of
// consecutive tiles exist at a time, which bounds memory however many tiles the items cover.
class TileLists {
  public:
    TileLists(const Grid &grid, const std::vector<BinItem> &items, int threads)
        : grid_(grid), items_(items), threads_(threads), count_(grid.tiles()), start_(1) {
        // A 2D prefix sum over the corners of the items' boxes counts the items of every tile.
        int w = grid.tiles_x + 1;
        std::vector<int32_t> corner((size_t)w * (grid.tiles_y + 1));
        for (auto &item : items) {
            MS_ASSERT(item.x0 <= item.x1 && item.x1 < grid.tiles_x);
            MS_ASSERT(item.y0 <= item.y1 && item.y1 < grid.tiles_y);
            ++corner[(size_t)item.y0 * w + item.x0];
            --corner[(size_t)item.y0 * w + item.x1 + 1];
            --corner[(size_t)(item.y1 + 1) * w + item.x0];
            ++corner[(size_t)(item.y1 + 1) * w + item.x1 + 1];
        }
        for (int y = 0; y < grid.tiles_y; ++y) {
            int32_t sum = 0;
            for (int x = 0; x < grid.tiles_x; ++x) {
                sum += corner[(size_t)y * w + x];
                count_[grid.tile_index(x, y)] = sum + (y ? count_[grid.tile_index(x, y - 1)] : 0);
            }
        }
    }

    // Builds the lists of the next range of tiles [begin(), end()); false if all tiles are done.
    bool next() {
        begin_ = end_;
        if (begin_ >= grid_.tiles()) return false;
        int64_t total = 0;
        start_.assign(1, 0);
        while (end_ < grid_.tiles() && (end_ == begin_ || total + count_[end_] <= MAX_ENTRIES)) {
            MS_ASSERT(count_[end_] >= 0);
            total += count_[end_++];
            start_.push_back(total);
        }
        entries_.resize(total);
        std::vector<int64_t> fill(start_.begin(), start_.end() - 1);
        const int threads = total < MIN_PARALLEL_ENTRIES ? 1 : threads_;
        // Each thread goes through all items and fills the lists of its own tiles. Threads have about equal
        // numbers of entries.
        on_threads(threads, [&](int thread) {
            const int64_t first = tile_at(total * thread / threads),
                          last = tile_at(total * (thread + 1) / threads);
            if (first < last) fill_lists(first, last, fill);
        });
        MS_ASSERT(std::equal(fill.begin(), fill.end(), start_.begin() + 1));
        return true;
    }

    int64_t begin() const { return begin_; }
    int64_t end() const { return end_; }
    const TileEntry *list(int64_t tile) const {
        MS_ASSERT(tile >= begin_ && tile < end_);
        return entries_.data() + start_[tile - begin_];
    }
    int64_t length(int64_t tile) const { return count_[tile]; }

  private:
    static constexpr int64_t MAX_ENTRIES = 4'000'000;  // in the lists of a range with more than one tile
    static constexpr int64_t MIN_PARALLEL_ENTRIES = 100'000;

    // The first tile of the range whose list starts at `entry` or later.
    int64_t tile_at(int64_t entry) const {
        return begin_ + (std::lower_bound(start_.begin(), start_.end(), entry) - start_.begin());
    }

    // Fills the lists of the tiles [first, last). fill[i] is the end of what is filled of tile begin_ + i.
    void fill_lists(int64_t first, int64_t last, std::vector<int64_t> &fill) {
        constexpr int STRIP = Grid::STRIP;
        const int64_t strip_tiles = (int64_t)STRIP * grid_.tiles_x;
        const int first_strip = (int)(first / strip_tiles), last_strip = (int)((last - 1) / strip_tiles);
        for (const BinItem &item : items_) {
            const int y0 = std::max<int>(item.y0, first_strip * STRIP),
                      y1 = std::min<int>(item.y1, last_strip * STRIP + STRIP - 1);
            for (int y = y0; y <= y1; ++y) {
                const int64_t step = std::min(STRIP, grid_.tiles_y - y / STRIP * STRIP);
                int64_t tile = grid_.tile_index(item.x0, y);
                for (int x = item.x0; x <= item.x1; ++x, tile += step)
                    if (tile >= first && tile < last) entries_[fill[tile - begin_]++] = item.entry;
            }
        }
    }

    const Grid &grid_;
    const std::vector<BinItem> &items_;
    int threads_;
    std::vector<int32_t> count_;  // entries of each tile of the image
    std::vector<int64_t> start_;  // list i of the range is entries_[start_[i]] to entries_[start_[i + 1]]
    PooledVector<TileEntry> entries_;
    int64_t begin_ = 0, end_ = 0;
};

}  // namespace ms
