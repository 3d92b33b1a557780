// The fragments of a block of samples that wait to be blended.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "lanes.h"
#include "triangle.h"

namespace ms {

// A triangle made ready for a tile: what its samples need. Positions count from the tile's corner.
struct TileTriangle {
    alignas(16) float a[4], b[4], c[4];  // RGBA / depth at (x, y) is a x + b y + c
    alignas(16) float low[4], high[4];   // range of RGBA over the corners
    float qa, qb, qc, q_min, q_max;      // the same for 1 / depth
    int32_t face;
    uint32_t number;       // in the tile's log
    int32_t uses;          // entries of lists that refer to it
    bool keys_are_depths;  // false where it is sorted by the common depth of its group
    float sa[3], sb[3], sc[3];  // the corners' weights / depth
};

// The triangles in use. Places are used again, so that what is in use lies close together.
class TilePool {
  public:
    int32_t take() {
        if (free_.empty()) {
            triangles_.emplace_back();
            return (int32_t)triangles_.size() - 1;
        }
        int32_t place = free_.back();
        free_.pop_back();
        return place;
    }
    void release(int32_t place) {
        if (--triangles_[place].uses == 0) free_.push_back(place);
    }
    void drop(int32_t place) { free_.push_back(place); }
    TileTriangle &operator[](int32_t place) { return triangles_[place]; }

  private:
    std::vector<TileTriangle> triangles_;
    std::vector<int32_t> free_;
};

// Entries are triangles with the lanes (samples of the block) that they cover and the keys there, 1 / depth.
class Waiting {
  public:
    int count() const { return count_; }
    bool full() const { return count_ >= limit_; }

    // Of the run of triangles number `run`; `covered` may be empty: then nothing is added.
    void add(TileTriangle &triangle, int32_t place, int32_t run, uint32_t covered, const Lanes &key) {
        if (!covered) return;
        if (pieces_.size() == piece_count_) pieces_.resize(std::max<size_t>(64, 2 * piece_count_));
        pieces_[piece_count_] = {place, covered};
        ++triangle.uses;
        if (count_ > 0 && entries_[count_ - 1].run == run && !(entries_[count_ - 1].lanes & covered)) {
            Entry &last = entries_[count_ - 1];
            last.lanes |= covered;
            ++last.pieces;
            float *keys = keys_[count_ - 1].key;
            store_lanes(keys, pick(covered, key, load_lanes(keys)));
        } else {
            if (count_ == (int)entries_.size()) {
                entries_.resize(std::max(32, 2 * count_));
                keys_.resize(entries_.size());
            }
            entries_[count_] = {covered, (int32_t)piece_count_, 1, run, triangle.face};
            store_lanes(keys_[count_].key, key);
            ++count_;
        }
        ++piece_count_;
    }

    void clear(TilePool &pool) {
        for (int i = 0; i < count_; ++i) release(pool, entries_[i]);
        count_ = 0;
        piece_count_ = 0;
        limit_ = ENTRIES;
    }

    // Calls blend(place of the triangle, lanes, keys) for all that is nearer than `nearest_to_come`, at every lane
    // nearest first, of equal keys the lower face first. `open` are the lanes that take light; `blend` may close some.
    template <class Blend>
    void take(TilePool &pool, float nearest_to_come, const uint32_t &open, Blend &&blend) {
        const Lanes limit = lanes(nearest_to_come);
        if (active_.size() < (size_t)count_) active_.resize(entries_.size());
        int n = 0;
        for (int i = 0; i < count_; ++i) {
            uint32_t ready = entries_[i].lanes & open & greater(load_lanes(keys_[i].key), limit);
            entries_[i].lanes &= open & ~ready;
            active_[n] = {i, ready};
            n += ready != 0;
        }
        if (n > MOST_AT_ONCE)
            lane_by_lane(n, open, blend);
        else if (n > 0)
            in_order(n, blend);
        int kept = 0;
        size_t kept_pieces = 0;
        for (int i = 0; i < count_; ++i) {
            Entry entry = entries_[i];
            entry.lanes &= open;
            if (!entry.lanes) {
                release(pool, entry);
                continue;
            }
            const int first = (int)kept_pieces;
            for (int p = entry.first; p < entry.first + entry.pieces; ++p) {
                if (pieces_[p].lanes & entry.lanes)
                    pieces_[kept_pieces++] = pieces_[p];
                else
                    pool.release(pieces_[p].place);
            }
            entry.first = first;
            entry.pieces = (int)kept_pieces - first;
            entry.run = -1;  // its pieces hold lanes that are done: none may be added to them
            entries_[kept] = entry;
            keys_[kept++] = keys_[i];
        }
        count_ = kept;
        piece_count_ = kept_pieces;
        // Entries that had to wait should not be looked at again and again.
        limit_ = std::max(ENTRIES, 2 * count_);
    }

    // Whether so much waits that it is worth looking for what is hidden.
    bool many() const { return count_ >= MANY_ENTRIES; }

    // Leaves of each entry only the lanes that `seen`, called like `blend` in take(), returns.
    template <class Seen>
    void keep(TilePool &pool, const uint32_t &open, Seen &&seen) {
        Waiting all = *this;
        for (size_t i = 0; i < piece_count_; ++i) ++pool[pieces_[i].place].uses;
        std::vector<uint32_t> visible(count_);
        take(pool, -1, open, [&](int32_t place, uint32_t ready, const float *key) {
            visible[(const Keys *)key - keys_.data()] |= seen(place, ready, key);
        });
        for (int i = 0; i < all.count_; ++i) all.entries_[i].lanes &= visible[i];
        std::swap(*this, all);
        all.clear(pool);
        const uint32_t every = (1u << LANES) - 1;
        // Drops what has become empty.
        take(pool, std::numeric_limits<float>::infinity(), every, [](int32_t, uint32_t, const float *) {});
    }

  private:
    static constexpr int ENTRIES = 8;  // a list is blended as far as possible once it is so long
    static constexpr int MANY_ENTRIES = 64, MOST_AT_ONCE = 64;

    // Triangles of one run that share no lane.
    struct Entry {
        uint32_t lanes;
        int32_t first, pieces;  // of the list of pieces
        int32_t run;
        int32_t face;  // the first one; entries of a run follow each other in the order of their faces
    };
    struct Piece {
        int32_t place;
        uint32_t lanes;
    };
    struct alignas(64) Keys {
        float key[LANES];
    };
    struct Active {
        int entry;
        uint32_t lanes;
    };

    void release(TilePool &pool, const Entry &entry) {
        for (int p = entry.first; p < entry.first + entry.pieces; ++p) pool.release(pieces_[p].place);
    }

    template <class Blend>
    void emit(int entry, uint32_t due, Blend &blend) {
        const Entry e = entries_[entry];
        for (int p = e.first; p < e.first + e.pieces; ++p)
            if (uint32_t part = pieces_[p].lanes & due) blend(pieces_[p].place, part, keys_[entry].key);
    }

    // Where each of the n active entries comes in the order of each lane, and the entries by the mean of that.
    struct Order {
        alignas(64) float rank[MOST_AT_ONCE][LANES];
        int entry[MOST_AT_ONCE];
    };

    // n <= N.
    template <int N>
    void rank(const int n, Order &order) const {
        Lanes key[N], rank[N];
        // By lane, how many come before; lanes that an entry does not cover have keys of their own below all others.
        for (int i = 0; i < N; ++i) {
            key[i] = i < n ? pick(active_[i].lanes, load_lanes(keys_[active_[i].entry].key), lanes(-1.0f - i)) : lanes(-1.0f - i);
            rank[i] = lanes(0);
        }
        uint32_t ties = 0;
#pragma GCC unroll 16
        for (int j = 1; j < N; ++j) {
#pragma GCC unroll 16
            for (int i = 0; i < j; ++i) ties |= count_before(key[i], key[j], rank[i], rank[j]);
        }
        finish_order(n, key, rank, ties, order);
    }

    void rank_more(const int n, Order &order) const {
        // Where a block takes many vectors, longer code costs more than it gains.
        if constexpr (PARTS <= 2) {
            if (n <= 12) return rank<12>(n, order);
            if (n <= 16) return rank<16>(n, order);
        }
        rank_many(n, order);
    }

    // The same for more.
    void rank_many(const int n, Order &order) const {
        Lanes key[MOST_AT_ONCE], rank[MOST_AT_ONCE];
        uint32_t ties = 0;
        for (int i = 0; i < n; ++i) {
            key[i] = pick(active_[i].lanes, load_lanes(keys_[active_[i].entry].key), lanes(-1.0f - i));
            rank[i] = lanes(0);
            for (int j = 0; j < i; ++j) ties |= count_before(key[j], key[i], rank[j], rank[i]);
        }
        finish_order(n, key, rank, ties, order);
    }

    void finish_order(const int n, const Lanes *key, Lanes *rank, uint32_t ties, Order &order) const {
        if (ties) {
            for (int j = 1; j < n; ++j)
                for (int i = 0; i < j; ++i)
                    if (entries_[active_[i].entry].face < entries_[active_[j].entry].face) {
                        const uint32_t tie = equal(key[i], key[j]);
                        rank[i] = rank[i] - only(tie, lanes(1));
                        rank[j] = rank[j] + only(tie, lanes(1));
                    }
        }
        float mean[MOST_AT_ONCE];
        for (int i = 0; i < n; ++i) {
            store_lanes(order.rank[i], rank[i]);
            mean[i] = sum(only(active_[i].lanes, rank[i])) / __builtin_popcount(active_[i].lanes);
        }
        for (int i = 0; i < n; ++i) {
            int place = 0;
            for (int j = 0; j < n; ++j) place += (mean[j] < mean[i]) | ((mean[j] == mean[i]) & (j < i));
            order.entry[place] = i;
        }
    }

    // Neighbouring samples nearly always agree on the order of two triangles, so mostly whole entries follow each other;
    // where they pierce each other, only some of their lanes are due at a time.
    template <class Blend>
    void in_order(const int n, Blend &blend) {
        Order order;
        if (n <= 4)
            rank<4>(n, order);
        else if (n <= 8)
            rank<8>(n, order);
        else
            rank_more(n, order);
        Lanes done = lanes(0);
        for (bool more = true; more;) {
            more = false;
            for (int place = 0; place < n; ++place) {
                const int i = order.entry[place];
                Active &a = active_[i];
                const uint32_t due = a.lanes & equal(load_lanes(order.rank[i]), done);
                if (due) emit(a.entry, due, blend);
                done = done + only(due, lanes(1));
                a.lanes &= ~due;
                more |= a.lanes != 0;
            }
        }
    }

    // For long lists.
    template <class Blend>
    void lane_by_lane(const int n, const uint32_t &open, Blend &blend) {
        struct Fragment {
            float key;
            int32_t face;
            int entry;
        };
        std::vector<Fragment> list;
        for (int lane = 0; lane < LANES; ++lane) {
            const uint32_t bit = 1u << lane;
            list.clear();
            for (int i = 0; i < n; ++i) {
                const Active &a = active_[i];
                if (a.lanes & bit) list.push_back({keys_[a.entry].key[lane], entries_[a.entry].face, a.entry});
            }
            std::sort(list.begin(), list.end(), [](const Fragment &a, const Fragment &b) {
                return a.key != b.key ? a.key > b.key : a.face < b.face;
            });
            for (const Fragment &f : list) {
                if (!(open & bit)) break;
                emit(f.entry, bit, blend);
            }
        }
    }

    std::vector<Entry> entries_;
    std::vector<Keys> keys_;
    std::vector<Piece> pieces_;
    std::vector<Active> active_;
    size_t piece_count_ = 0;
    int count_ = 0, limit_ = ENTRIES;
};

}  // namespace ms
