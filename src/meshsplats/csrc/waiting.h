// The fragments of a block of samples that wait to be blended.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "lanes.h"

namespace ms {

// A sample takes at most one fragment of an entry: where the triangles of a run lie side by side, as those of
// a fan, they share it. Lanes are the samples of the block.
struct Fragments {
    Lanes key;      // 1 / depth by which they are sorted
    Lanes rgba[4];  // finite in every lane
};

// What only some pictures need.
struct FragmentWeights {
    Lanes z;     // depth
    Lanes b[3];  // of the corners, before they are made to sum to 1
};

class Waiting {
  public:
    int count() const { return count_; }
    bool full() const { return count_ >= limit_; }
    const Fragments &fragments(int entry) const { return fragments_[entry]; }
    const FragmentWeights &weights(int entry) const { return weights_[entry]; }

    uint32_t first_piece(int entry) const { return entries_[entry].first_piece; }
    uint32_t pieces(int entry) const { return entries_[entry].pieces; }
    // Its number in the log.
    static constexpr uint32_t NO_NUMBER = UINT32_MAX;
    uint32_t &number(int entry) { return entries_[entry].number; }

    // Where the fragments of the next entry are to be put.
    Fragments &next() {
        if (count_ == (int)entries_.size()) {
            entries_.resize(std::max(32, 2 * count_));
            fragments_.resize(entries_.size());
        }
        return fragments_[count_];
    }
    // Adds that entry. `face` is its first face; entries of a run follow each other in the order of their
    // faces. Weights may be null, and pieces [first_piece, first_piece + pieces) of those found in the tile
    // none.
    void add(uint32_t covered, int32_t face, const FragmentWeights *weights, uint32_t first_piece,
             uint32_t pieces) {
        if (weights) {
            weights_.resize(entries_.size());
            weights_[count_] = *weights;
        }
        entries_[count_++] = {covered, face, first_piece, pieces, NO_NUMBER};
    }

    void clear() {
        count_ = 0;
        limit_ = ENTRIES;
    }

    // Calls blend(entry, lanes) for all that is nearer than `nearest_to_come`, at every lane nearest first,
    // of equal keys the lower face first. `open` are the lanes that take light; `blend` may close some.
    template <class Blend>
    void take(float nearest_to_come, const uint32_t &open, Blend &&blend) {
        const Lanes limit = lanes(nearest_to_come);
        if (active_.size() < (size_t)count_) active_.resize(entries_.size());
        int n = 0;
        for (int i = 0; i < count_; ++i) {
            uint32_t ready = entries_[i].lanes & open & greater(fragments_[i].key, limit);
            entries_[i].lanes &= open & ~ready;
            active_[n] = {i, ready};
            n += ready != 0;
        }
        visit(n, open, blend);
        drop_empty(open);
    }

    // Whether so much waits that it is worth looking for what is hidden.
    bool many() const { return count_ >= MANY_ENTRIES; }

    // Leaves of each entry only the lanes that `seen`, called like `blend` in take(), returns.
    template <class Seen>
    void keep(const uint32_t &open, Seen &&seen) {
        active_.resize(entries_.size());
        std::vector<uint32_t> visible(count_);
        for (int i = 0; i < count_; ++i) active_[i] = {i, entries_[i].lanes};
        visit(count_, open, [&](int entry, uint32_t ready) { visible[entry] |= seen(entry, ready); });
        for (int i = 0; i < count_; ++i) entries_[i].lanes = visible[i];
        drop_empty((1u << LANES) - 1);
    }

  private:
    static constexpr int ENTRIES = 8;  // a list is blended as far as possible once it is so long
    static constexpr int MANY_ENTRIES = 256;
    // Where a block takes many vectors, longer code to rank costs more than it gains.
    static constexpr int MOST_TO_RANK = PARTS <= 2 ? 16 : 8, MOST_TO_SEARCH = 512;
    static_assert(MOST_TO_RANK <= LANES);

    struct Entry {
        uint32_t lanes;
        int32_t face;
        uint32_t first_piece, pieces, number;
    };
    struct Active {
        int entry;
        uint32_t lanes;
    };

    void drop_empty(uint32_t open) {
        int kept = 0;
        for (int i = 0; i < count_; ++i) {
            if (!(entries_[i].lanes &= open)) continue;
            if (kept < i) {
                entries_[kept] = entries_[i];
                fragments_[kept] = fragments_[i];
                if (!weights_.empty()) weights_[kept] = weights_[i];
            }
            ++kept;
        }
        count_ = kept;
        // Entries that had to wait should not be looked at again and again.
        limit_ = std::max(ENTRIES, 2 * count_);
    }

    template <class Blend>
    void visit(int n, const uint32_t &open, Blend &&blend) {
        if (n > MOST_TO_SEARCH)
            lane_by_lane(n, open, blend);
        else if (n > MOST_TO_RANK)
            nearest_first(n, open, blend);
        else if (n > 0)
            in_order(n, blend);
    }

    // Where each of the n active entries comes in the order of each lane, and the entries by the mean of
    // that.
    struct Order {
        Lanes rank[MOST_TO_RANK];
        int entry[MOST_TO_RANK];
    };

    // n <= N.
    template <int N>
    void rank(const int n, Order &order) const {
        Lanes key[N], rank[N];
        // By lane, how many come before; lanes that an entry does not cover have keys of their own below all
        // others.
        for (int i = 0; i < N; ++i) {
            key[i] = i < n ? pick(active_[i].lanes, fragments_[active_[i].entry].key, lanes(-1.0f - i))
                           : lanes(-1.0f - i);
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
        alignas(64) float mean[LANES];
        std::fill(mean, mean + LANES, std::numeric_limits<float>::max());
        for (int i = 0; i < n; ++i) {
            order.rank[i] = rank[i];
            mean[i] = sum(only(active_[i].lanes, rank[i])) / __builtin_popcount(active_[i].lanes);
        }
        const Lanes means = load_lanes(mean);
        for (int i = 0; i < n; ++i) {
            const unsigned before =
                greater(lanes(mean[i]), means) | (equal(lanes(mean[i]), means) & ((1u << i) - 1));
            order.entry[__builtin_popcount(before)] = i;
        }
    }

    // Neighbouring samples nearly always agree on the order of two triangles, so mostly whole entries follow
    // each other; where they pierce each other, only some of their lanes are due at a time.
    template <class Blend>
    void in_order(const int n, Blend &blend) {
        Order order;
        if (n <= 4)
            rank<4>(n, order);
        else if (n <= 6)
            rank<6>(n, order);
        else if (n <= 8)
            rank<8>(n, order);
        else if constexpr (MOST_TO_RANK > 8)
            n <= 12 ? rank<12>(n, order) : rank<16>(n, order);
        Lanes done = lanes(0);
        for (uint32_t left = (1u << n) - 1; left;) {
            for (uint32_t rest = left; rest; rest &= rest - 1) {
                const int place = __builtin_ctz(rest), i = order.entry[place];
                Active &a = active_[i];
                const uint32_t due = a.lanes & equal(order.rank[i], done);
                if (due) blend(a.entry, due);
                done = done + only(due, lanes(1));
                a.lanes &= ~due;
                left &= ~((uint32_t)!a.lanes << place);
            }
        }
    }

    // For longer lists, of which mostly only the nearest matter: finds those of every lane, again and again.
    template <class Blend>
    void nearest_first(int n, const uint32_t &open, Blend &blend) {
        constexpr float NONE = -1, DONE = -2;
        if (left_.size() < (size_t)n) left_.resize(n);
        for (int i = 0; i < n; ++i)
            left_[i] = pick(active_[i].lanes, fragments_[active_[i].entry].key, lanes(DONE));
        for (int round = 1;; ++round) {
            Lanes nearest = lanes(NONE), which = lanes(0);
            for (int i = 0; i < n; ++i) {
                const uint32_t ties = equal(left_[i], nearest);
                pick_greater(left_[i], lanes((float)i), nearest, which);
                if (ties) lower_face(i, ties, which);
            }
            uint32_t rest = open & greater(nearest, lanes(NONE));
            if (!rest) return;
            alignas(64) float places[LANES];
            store_lanes(places, which);
            while (rest) {
                const float place = places[__builtin_ctz(rest)];
                const uint32_t due = rest & equal(which, lanes(place));
                left_[(int)place] = pick(due, lanes(DONE), left_[(int)place]);
                active_[(int)place].lanes &= ~due;
                blend(active_[(int)place].entry, due);
                rest &= ~due;
            }
            if (round % 8) continue;
            // What is done is not looked at any more.
            int kept = 0;
            for (int i = 0; i < n; ++i) {
                active_[kept] = active_[i];
                left_[kept] = left_[i];
                kept += (active_[i].lanes & open) != 0;
            }
            n = kept;
        }
    }

    // At `ties`, leaves in `which` that of both entries that has the lower face.
    void lower_face(int i, uint32_t ties, Lanes &which) const {
        alignas(64) float places[LANES];
        store_lanes(places, which);
        for (; ties; ties &= ties - 1) {
            float &place = places[__builtin_ctz(ties)];
            if (entries_[active_[i].entry].face < entries_[active_[(int)place].entry].face) place = (float)i;
        }
        which = load_lanes(places);
    }

    // For very long lists.
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
                if (a.lanes & bit)
                    list.push_back({lane_of(fragments_[a.entry].key, lane), entries_[a.entry].face, a.entry});
            }
            std::sort(list.begin(), list.end(), [](const Fragment &a, const Fragment &b) {
                return a.key != b.key ? a.key > b.key : a.face < b.face;
            });
            for (const Fragment &f : list) {
                if (!(open & bit)) break;
                blend(f.entry, bit);
            }
        }
    }

    std::vector<Entry> entries_;
    std::vector<Fragments> fragments_;
    std::vector<FragmentWeights> weights_;
    std::vector<Active> active_;
    std::vector<Lanes> left_;
    int count_ = 0, limit_ = ENTRIES;
};

}  // namespace ms
