// The sample grid, its tiles, and the depth-ordered list of what may touch each tile.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "large.h"
#include "parallel.h"
#include "types.h"

namespace ms {

constexpr int TILE = 16;  // samples a side; fixed, so that rounding does not depend on the vector width

struct Grid {
    int samples;        // a pixel side
    int width, height;  // in samples
    int side;           // samples a tile side in use: the largest multiple of `samples` up to TILE
    int tiles_x, tiles_y;

    Grid(const MsCamera &camera, int samples)
        : samples(samples),
          width(camera.width * samples),
          height(camera.height * samples),
          side(TILE / samples * samples),
          tiles_x((width + side - 1) / side),
          tiles_y((height + side - 1) / side) {}
    int64_t tiles() const { return (int64_t)tiles_x * tiles_y; }

    // The column or row of tiles of a sample: its place / side, without the division, which takes longer than
    // all else that is asked of a small triangle.
    int tile_of(int place) const { return (int)((uint64_t)place * share_ >> 32); }

    // Tiles are numbered down and then across strips of a few rows, so that what one tile reads is still at
    // hand for its neighbours in both directions.
    static constexpr int STRIP = 4;
    int64_t tile(int x, int y) const {
        const int first = y / STRIP * STRIP;
        return (int64_t)first * tiles_x + (int64_t)x * std::min(STRIP, tiles_y - first) + (y - first);
    }
    void place(int64_t tile, int &x, int &y) const {
        const int first = (int)(tile / ((int64_t)STRIP * tiles_x)) * STRIP,
                  rows = std::min(STRIP, tiles_y - first);
        const int64_t rest = tile - (int64_t)first * tiles_x;
        x = (int)(rest / rows);
        y = first + (int)(rest % rows);
    }

  private:
    uint64_t share_ = (UINT64_C(1) << 32) / side + 1;  // exact for places below 2^28 and sides up to 16
};

// Something to draw: a run of triangles, or a splat.
struct Entry {
    float key;  // no sample of it is nearer: compared with 1 / depth, nearest first
    int32_t first, length;
};

// The same with the tiles it may touch, inclusive.
struct Item {
    Entry entry;
    uint16_t x0, x1, y0, y1;
};

// First and last sample whose centre lies in [lo, hi] widened a little, clamped to [0, count).
inline bool sample_range(double lo, double hi, int count, int &first, int &last) {
    constexpr double slack = 1e-3;  // rounding of edge functions must never find a sample outside the box
    double a = std::ceil(lo - 0.5 - slack), b = std::floor(hi - 0.5 + slack);
    if (!(b >= 0) || !(a <= count - 1) || !(a <= b)) return false;
    first = a > 0 ? (int)a : 0;
    last = b < count - 1 ? (int)b : count - 1;
    return true;
}

// Orders items nearest first (stable radix sort by key, which is >= 0).
inline void sort_items(std::vector<Item> &items) {
    struct Place {
        uint32_t key, item;
    };
    std::vector<Place> places(items.size()), other(items.size());
    constexpr int PASSES = 3, BITS = 11, DIGITS = 1 << BITS;
    std::vector<uint32_t> start(PASSES * DIGITS);
    auto digit = [](uint32_t key, int pass) { return key >> (BITS * pass) & (DIGITS - 1); };
    for (size_t i = 0; i < items.size(); ++i) {
        uint32_t bits;
        std::memcpy(&bits, &items[i].entry.key, 4);
        places[i] = {~bits, (uint32_t)i};
        for (int pass = 0; pass < PASSES; ++pass) ++start[pass * DIGITS + digit(~bits, pass)];
    }
    for (int pass = 0; pass < PASSES; ++pass) {
        uint32_t sum = 0, *of = &start[pass * DIGITS];
        for (int i = 0; i < DIGITS; ++i) {
            const uint32_t n = of[i];
            of[i] = sum;
            sum += n;
        }
        for (const Place &place : places) other[of[digit(place.key, pass)]++] = place;
        places.swap(other);
    }
    std::vector<Item> sorted(items.size());
    for (size_t i = 0; i < items.size(); ++i) sorted[i] = items[places[i].item];
    items.swap(sorted);
}

// Tile lists for a run of consecutive tiles, in the order of the items. Long lists are made a run of tiles at
// a time, so that memory stays bounded however many tiles the items cover.
class TileLists {
  public:
    TileLists(const Grid &grid, const std::vector<Item> &items, int threads)
        : grid_(grid), items_(items), threads_(threads), count_(grid.tiles()), start_(1) {
        // Corner counts summed along both axes give every tile's number of items.
        int w = grid.tiles_x + 1;
        std::vector<int32_t> corner((size_t)w * (grid.tiles_y + 1));
        for (auto &item : items) {
            ++corner[(size_t)item.y0 * w + item.x0];
            --corner[(size_t)item.y0 * w + item.x1 + 1];
            --corner[(size_t)(item.y1 + 1) * w + item.x0];
            ++corner[(size_t)(item.y1 + 1) * w + item.x1 + 1];
        }
        for (int y = 0; y < grid.tiles_y; ++y) {
            int32_t sum = 0;
            for (int x = 0; x < grid.tiles_x; ++x) {
                sum += corner[(size_t)y * w + x];
                count_[grid.tile(x, y)] = sum + (y ? count_[grid.tile(x, y - 1)] : 0);
            }
        }
    }

    // Prepares the lists of the next run of tiles [begin(), end()); false when all are done.
    bool next() {
        begin_ = end_;
        if (begin_ >= grid_.tiles()) return false;
        int64_t total = 0;
        start_.assign(1, 0);
        while (end_ < grid_.tiles() && (end_ == begin_ || total + count_[end_] <= budget)) {
            total += count_[end_++];
            start_.push_back(total);
        }
        entries_.resize(total);
        std::vector<int64_t> fill(start_.begin(), start_.end() - 1);
        // Each thread fills the lists of its own tiles; about equal numbers of entries each.
        on_threads(total < 100000 ? 1 : threads_, [&](int thread) {
            int n = total < 100000 ? 1 : threads_;
            int64_t a = bound(total * thread / n), b = bound(total * (thread + 1) / n);
            if (a >= b) return;
            constexpr int strip = Grid::STRIP;
            const int strip_a = (int)(a / ((int64_t)strip * grid_.tiles_x)),
                      strip_b = (int)((b - 1) / ((int64_t)strip * grid_.tiles_x));
            for (const Item &item : items_) {
                const int y0 = std::max<int>(item.y0, strip_a * strip),
                          y1 = std::min<int>(item.y1, strip_b * strip + strip - 1);
                for (int y = y0; y <= y1; ++y) {
                    const int64_t step = std::min(strip, grid_.tiles_y - y / strip * strip);
                    int64_t tile = grid_.tile(item.x0, y);
                    for (int x = item.x0; x <= item.x1; ++x, tile += step)
                        if (tile >= a && tile < b) entries_[fill[tile - begin_]++] = item.entry;
                }
            }
        });
        return true;
    }

    int64_t begin() const { return begin_; }
    int64_t end() const { return end_; }
    const Entry *list(int64_t tile) const { return entries_.data() + start_[tile - begin_]; }
    int64_t length(int64_t tile) const { return count_[tile]; }

  private:
    static constexpr int64_t budget = 4'000'000;  // entries held at once

    int64_t bound(int64_t entries) const {
        return begin_ + (std::lower_bound(start_.begin(), start_.end(), entries) - start_.begin());
    }

    const Grid &grid_;
    const std::vector<Item> &items_;
    int threads_;
    std::vector<int32_t> count_;
    std::vector<int64_t> start_;
    Large<Entry> entries_;
    int64_t begin_ = 0, end_ = 0;
};

}  // namespace ms
