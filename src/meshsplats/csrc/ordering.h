// One order of blending for all views: the order that a file lists its triangles in, for viewers that do not
// sort.
//
// Of a planar piece of a splat, viewers that cull show one side. The sides are the units that are ordered. In
// each view, pairs of units that overlap at a pixel want the farther one first; a pair counts by what the
// pixel would lose. The order of least loss is a linear ordering problem (Martí and Reinelt, The Linear
// Ordering Problem, 2011): it is searched by moving one unit at a time to its best place.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "insertion.h"
#include "parallel.h"
#include "pooled_vector.h"
#include "triangle.h"

extern "C" {

struct MsOrdering {
    int64_t vertex_count, face_count, piece_count;
    const float *vertices;       // (vertex_count, 3)
    const float *colors;         // (vertex_count, 4) straight RGBA
    const int32_t *faces;        // (face_count, 3), those of a piece side by side
    const uint8_t *turned;       // (face_count,) 1: its winding shows the back of the piece
    const int64_t *piece_start;  // (piece_count + 1,) first face
    const double *centers;       // (piece_count, 3): a piece lies in a view as far away as its centre
    const int32_t *splat;        // (piece_count,) pieces of one splat form no pairs
    const int32_t *node;         // (piece_count,) nor do pieces of different nodes
    const MsCamera *cameras;     // (camera_count,)
    int32_t camera_count, sweeps, threads;
    int64_t max_pairs;  // the heaviest ones are kept
    int32_t *rank;  // (2 piece_count,) places of the units 2 piece + back: at the start, and the best found
    int64_t pairs;  // out: pairs that were kept
    double weight;  // out: of all of them
    double before, after;  // out: of those in the wrong order
};

}  // extern "C"

namespace ms {

// A sum of weights for two units, low < high: positive if `high` should come later, being nearer.
struct UnitPair {
    uint32_t low, high;
    float weight;
};

// The sums of a part of all pairs, which part_of() tells.
class PairTable {
  public:
    // Of all pairs, each of `parts` has about as many.
    static size_t part_of(uint32_t low, uint32_t high, int parts) {
        return (size_t)((hash(low, high) >> 32) * parts >> 32);
    }

    // Adds `pair`. Of `most` pairs, the lighter half is forgotten before.
    void add(const UnitPair &pair, size_t most) {
        if (count_ >= most) forget(most / 2);
        if (3 * (count_ + 1) > 2 * slots_.size()) grow(most);
        UnitPair &slot = find(pair.low, pair.high);
        if (slot.low == slot.high) {
            slot = pair;
            ++count_;
        } else {
            slot.weight += pair.weight;
        }
    }

    void forget(size_t kept) {
        if (count_ <= kept) return;
        auto heavier = [](const UnitPair &a, const UnitPair &b) {
            const float x = std::fabs(a.weight), y = std::fabs(b.weight);
            if (x != y) return x > y;
            return a.low != b.low ? a.low < b.low : a.high < b.high;
        };
        std::vector<UnitPair> all = pairs();
        std::nth_element(all.begin(), all.begin() + kept, all.end(), heavier);
        all.resize(kept);
        fill(all, slots_.size());
    }

    std::vector<UnitPair> pairs() const {
        std::vector<UnitPair> result;
        result.reserve(count_);
        for (const UnitPair &slot : slots_)
            if (slot.low != slot.high) result.push_back(slot);
        return result;
    }

    void clear() { std::vector<UnitPair>().swap(slots_), count_ = 0; }

  private:
    std::vector<UnitPair> slots_;  // low == high: empty
    size_t count_ = 0;

    // To four slots for each pair, but no more than `most` pairs need.
    void grow(size_t most) {
        size_t size = 1024;
        while (size < 4 * count_ && 2 * size < 3 * most) size *= 2;
        fill(pairs(), size);
    }
    void fill(const std::vector<UnitPair> &pairs, size_t size) {
        slots_.assign(size, {0, 0, 0});
        count_ = pairs.size();
        for (const UnitPair &pair : pairs) find(pair.low, pair.high) = pair;
    }
    static uint64_t hash(uint32_t low, uint32_t high) {
        return (low * 0x9E3779B97F4A7C15ull ^ high) * 0xD1B54A32D192ED03ull;
    }
    UnitPair &find(uint32_t low, uint32_t high) {
        const size_t mask = slots_.size() - 1;
        size_t i = (size_t)(hash(low, high) >> 20) & mask;
        while (slots_[i].low != slots_[i].high && (slots_[i].low != low || slots_[i].high != high))
            i = (i + 1) & mask;
        return slots_[i];
    }
};

// The pairs of one view. Pieces are drawn front to back. Every fragment is paired with a few of those in
// front of it, drawn at random by their shares of the pixel: these pairs stand for those with all of them.
// What was drawn stays until another layer takes its place (reservoir sampling; Vitter, 1985): a list of all
// layers of a pixel would not fit into the cache.
class ViewPairs {
  public:
    ViewPairs(const MsOrdering &ordering, int parts) : in_(ordering), parts_(parts), cache_(CACHE) {}

    // Appends the pairs of a view to `out`, a list for each part of them.
    void collect(int view, std::vector<UnitPair> *out) {
        const MsCamera &camera = in_.cameras[view];
        width_ = camera.width, height_ = camera.height;
        out_ = out;
        random_ = 0x9E3779B97F4A7C15ull * (view + 1);
        pixels_.assign((size_t)width_ * height_, {1, {}});
        std::fill(cache_.begin(), cache_.end(), UnitPair{0, 0, 0});
        const Projection projection(camera, 1);
        vertices_.resize(in_.vertex_count);
        for (int64_t i = 0; i < in_.vertex_count; ++i) {
            const Projected p = projection.project(projection.to_camera(in_.vertices + 3 * i));
            vertices_[i] = {(float)p.x, (float)p.y, p.w > 0};
        }
        const double *m = camera.world_to_camera + 8;
        order_.clear();
        for (int64_t i = 0; i < in_.piece_count; ++i) {
            const double *c = in_.centers + 3 * i;
            order_.push_back({(float)(m[0] * c[0] + m[1] * c[1] + m[2] * c[2] + m[3]), (int32_t)i});
        }
        std::sort(order_.begin(), order_.end());
        for (const auto &[depth, piece] : order_) {
            stop_point();
            for (int64_t face = in_.piece_start[piece]; face < in_.piece_start[piece + 1]; ++face)
                draw(piece, face);
        }
        for (const UnitPair &pair : cache_)
            if (pair.low != pair.high) put(pair);
    }

  private:
    static constexpr int DRAWS = 4;  // pairs of a fragment
    static constexpr size_t CACHE = 1 << 14;
    static constexpr float FAINT = 1.f / 64;   // fragments of less opacity do not count
    static constexpr float HIDDEN = 1.f / 50;  // nor are fragments behind this transmittance seen
    static constexpr float LEAST = 0.01f;      // lighter pairs are taken by chance, with this weight
    static constexpr float ALIKE = 1e-3f;      // square difference of colours that all pairs have

    struct Point {
        float x, y;
        bool visible;
    };
    struct Layer {
        uint32_t unit;
        int32_t splat, node;
        float color[3];
    };
    struct Pixel {
        float transmittance;
        Layer drawn[DRAWS];  // each is any layer so far, with the probability of its share
    };

    const MsOrdering &in_;
    const int parts_;
    int width_ = 0, height_ = 0;
    std::vector<UnitPair> *out_ = nullptr;
    uint64_t random_ = 0;
    PooledVector<Pixel> pixels_;
    PooledVector<Point> vertices_;
    std::vector<std::pair<float, int32_t>> order_;
    std::vector<UnitPair> cache_;  // sums of pairs that were seen a moment ago

    float chance() {  // [0, 1), xorshift
        random_ ^= random_ << 13, random_ ^= random_ >> 7, random_ ^= random_ << 17;
        return (float)(random_ >> 40) * 0x1p-24f;
    }
    void put(const UnitPair &pair) { out_[PairTable::part_of(pair.low, pair.high, parts_)].push_back(pair); }

    void draw(int32_t piece, int64_t face) {
        const int32_t *f = in_.faces + 3 * face;
        const Point &a = vertices_[f[0]], &b = vertices_[f[1]], &c = vertices_[f[2]];
        if (!(a.visible && b.visible && c.visible)) return;
        const float area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        const float top = std::min({a.y, b.y, c.y}), bottom = std::max({a.y, b.y, c.y});
        const float left = std::min({a.x, b.x, c.x}), right = std::max({a.x, b.x, c.x});
        if (!(std::fabs(area) > 1e-12f && bottom > 0 && right > 0 && top < height_ && left < width_)) return;
        const float *ca = in_.colors + 4 * (int64_t)f[0], *cb = in_.colors + 4 * (int64_t)f[1],
                    *cc = in_.colors + 4 * (int64_t)f[2];
        if (std::max({ca[3], cb[3], cc[3]}) < FAINT) return;
        // Fronts turn counter-clockwise; y points down here.
        const uint32_t unit = 2 * (uint32_t)piece + ((area > 0) != (in_.turned[face] != 0));
        Layer layer{unit, in_.splat[piece], in_.node[piece], {}};
        for (int k = 0; k < 3; ++k) layer.color[k] = (ca[k] + cb[k] + cc[k]) * (1.f / 3);
        const int first = std::max(0, (int)std::ceil(std::max(top, -1.f) - 0.5f));
        const int last = std::min(height_ - 1, (int)std::floor(std::min(bottom, height_ + 1.f) - 0.5f));
        const Point *corner[4] = {&a, &b, &c, &a};
        const float inverse = 1 / area;
        const float slope = (cb[3] - ca[3]) * (c.y - a.y) * inverse - (cc[3] - ca[3]) * (b.y - a.y) * inverse;
        const float down = (cc[3] - ca[3]) * (b.x - a.x) * inverse - (cb[3] - ca[3]) * (c.x - a.x) * inverse;
        for (int y = first; y <= last; ++y) {
            const float py = y + 0.5f;
            float low = left, high = right;  // the row's part in the triangle
            float enter = right, leave = left;
            for (int k = 0; k < 3; ++k) {
                const Point &p = *corner[k], &q = *corner[k + 1];
                if ((p.y <= py) == (q.y <= py)) continue;
                const float x = p.x + (py - p.y) / (q.y - p.y) * (q.x - p.x);
                enter = std::min(enter, x), leave = std::max(leave, x);
            }
            low = std::max(low, enter), high = std::min(high, leave);
            // Limited first: slivers of huge triangles have ends that no int holds.
            const int begin = std::max(0, (int)std::ceil(std::clamp(low, -1.f, width_ + 1.f) - 0.5f));
            const int end = (int)std::ceil(std::clamp(high, -1.f, width_ + 1.f) - 0.5f);
            for (int x = begin; x < std::min(end, width_); ++x) {
                const float alpha = ca[3] + slope * (x + 0.5f - a.x) + down * (py - a.y);
                if (alpha >= FAINT) blend(pixels_[(size_t)y * width_ + x], layer, std::min(alpha, 1.f));
            }
        }
    }

    void blend(Pixel &pixel, const Layer &layer, float alpha) {
        const float all = 1 - pixel.transmittance;
        if (all > 0)
            for (const Layer &near : pixel.drawn) pair(near, layer, all * alpha / DRAWS);
        if (pixel.transmittance <= HIDDEN) return;
        const float share = pixel.transmittance * alpha;
        pixel.transmittance -= share;
        for (Layer &near : pixel.drawn)
            if (chance() * (all + share) < share) near = layer;
    }

    void pair(const Layer &near, const Layer &far, float share) {
        if (near.splat == far.splat || near.node != far.node) return;
        float difference = ALIKE;
        for (int k = 0; k < 3; ++k) {
            const float d = near.color[k] - far.color[k];
            difference += d * d;
        }
        float weight = share * difference;
        if (weight < LEAST) {
            if (chance() * LEAST >= weight) return;
            weight = LEAST;
        }
        const bool later = near.unit > far.unit;
        const uint32_t low = later ? far.unit : near.unit, high = later ? near.unit : far.unit;
        UnitPair &known = cache_[(low * 0x9E3779B1u ^ high * 0x85EBCA77u) >> 18];
        if (known.low != low || known.high != high) {
            if (known.low != known.high) put(known);
            known = {low, high, 0};
        }
        known.weight += later ? weight : -weight;
    }
};

class Ordering {
  public:
    explicit Ordering(MsOrdering &ordering) : io_(ordering), units_(2 * ordering.piece_count) {}

    void run() {
        MS_ASSERT(io_.piece_count >= 1 && units_ <= MOST_UNITS && io_.threads >= 1);
        collect();
        link();
        start();
        io_.before = io_.after = loss();
        for (int sweep = 0; sweep < io_.sweeps; ++sweep) {
            for (int round = 0; round < ROUNDS; ++round) move(sweep, round);
            number();
            const double found = loss();
            if (found >= io_.after) continue;
            io_.after = found;
            for (int64_t i = 0; i < units_; ++i) io_.rank[i] = key_[i] / spacing_;
        }
    }

  private:
    static constexpr int PARTS = 256, VIEWS = 8;  // views whose pairs wait to be added
    static constexpr int ROUNDS = 8;              // of a sweep: units of one move at once
    static constexpr int64_t MOST_UNITS = (int64_t)1 << 29, BLOCK = 4096;

    struct Edge {
        int32_t unit;
        float weight;  // positive: this unit lies before the one whose edge it is
    };

    MsOrdering &io_;
    const int64_t units_;
    int32_t spacing_ = 1;
    PairTable tables_[PARTS];
    PooledVector<int64_t> start_;
    PooledVector<Edge> edges_;
    PooledVector<int32_t> key_, moved_;
    PooledVector<int64_t> order_;

    void collect() {
        std::vector<std::vector<UnitPair>> waiting((size_t)VIEWS * PARTS);
        std::vector<std::unique_ptr<ViewPairs>> workers(io_.threads);
        const size_t most = (size_t)io_.max_pairs / PARTS + 1;
        for (int first = 0; first < io_.camera_count; first += VIEWS) {
            const int count = std::min(VIEWS, io_.camera_count - first);
            parallel_blocks(io_.threads, count, 1, [&](int64_t begin, int64_t, int thread) {
                if (!workers[thread]) workers[thread] = std::make_unique<ViewPairs>(io_, PARTS);
                workers[thread]->collect(first + (int)begin, &waiting[begin * PARTS]);
            });
            parallel_blocks(io_.threads, PARTS, 1, [&](int64_t part, int64_t, int) {
                for (int view = 0; view < count; ++view) {
                    std::vector<UnitPair> &list = waiting[(size_t)view * PARTS + part];
                    for (const UnitPair &pair : list) tables_[part].add(pair, 2 * most);
                    list.clear();
                }
            });
        }
        parallel_blocks(io_.threads, PARTS, 1,
                        [&](int64_t part, int64_t, int) { tables_[part].forget(most); });
    }

    // The pairs as a list of neighbours of every unit.
    void link() {
        start_.assign(units_ + 1, 0);
        io_.pairs = 0, io_.weight = 0;
        for (const PairTable &table : tables_)
            for (const UnitPair &pair : table.pairs()) {
                ++start_[pair.low + 1], ++start_[pair.high + 1];
                ++io_.pairs;
                io_.weight += std::fabs(pair.weight);
            }
        for (int64_t i = 0; i < units_; ++i) start_[i + 1] += start_[i];
        edges_.resize(start_[units_]);
        PooledVector<int64_t> end(start_.begin(), start_.end() - 1);
        for (PairTable &table : tables_) {
            for (const UnitPair &pair : table.pairs()) {
                edges_[end[pair.low]++] = {(int32_t)pair.high, -pair.weight};
                edges_[end[pair.high]++] = {(int32_t)pair.low, pair.weight};
            }
            table.clear();
        }
    }

    void start() {
        spacing_ = (int32_t)std::min<int64_t>(1 << 20, ((int64_t)1 << 30) / units_);
        key_.resize(units_), moved_.resize(units_), order_.resize(units_);
        for (int64_t i = 0; i < units_; ++i) key_[i] = io_.rank[i] * spacing_;
    }

    // Spreads the keys evenly in their order.
    void number() {
        for (int64_t i = 0; i < units_; ++i) order_[i] = key_[i] * ((int64_t)1 << 32) + i;
        std::sort(order_.begin(), order_.end());
        for (int64_t i = 0; i < units_; ++i) key_[(uint32_t)order_[i]] = (int32_t)i * spacing_;
    }

    // The weight of the pairs in the wrong order.
    double loss() const {
        const int64_t blocks = (units_ + BLOCK - 1) / BLOCK;
        std::vector<double> sums(blocks);
        parallel_blocks(io_.threads, units_, BLOCK, [&](int64_t begin, int64_t end, int) {
            double sum = 0;
            for (int64_t i = begin; i < end; ++i)
                for (int64_t e = start_[i]; e < start_[i + 1]; ++e)
                    if ((edges_[e].weight > 0) != (key_[edges_[e].unit] < key_[i]))
                        sum += std::fabs(edges_[e].weight);
            sums[begin / BLOCK] = sum;
        });
        double total = 0;
        for (double sum : sums) total += sum;
        return total / 2;  // both units of a pair count it
    }

    // Moves the units of a round, all as if the others stayed.
    void move(int sweep, int round) {
        parallel_blocks(io_.threads, units_, BLOCK, [&](int64_t begin, int64_t end, int) {
            Insertion insertion;
            for (int64_t i = begin; i < end; ++i)
                moved_[i] = turn(i, sweep) == round ? best(i, insertion) : key_[i];
        });
        std::swap(key_, moved_);
    }
    static int turn(int64_t unit, int sweep) {
        return (int)(((uint64_t)unit * 64 + sweep) * 0x9E3779B97F4A7C15ull >> 40) % ROUNDS;
    }

    // The key of a unit at its best place among its neighbours, or its own.
    int32_t best(int64_t unit, Insertion &insertion) const {
        insertion.clear();
        for (int64_t e = start_[unit]; e < start_[unit + 1]; ++e)
            insertion.add({key_[edges_[e].unit], edges_[e].weight});
        return insertion.best(key_[unit], spacing_);
    }
};

}  // namespace ms
