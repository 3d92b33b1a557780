// The fragments of one block of samples that are not yet blended.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "check.h"
#include "lanes.h"

namespace ms {

// Per lane, the fragment of one queue entry. An entry holds at most one fragment per sample; the triangles of
// a group that lie side by side, as those of a fan do, share an entry.
struct Fragments {
    Lanes key;      // sort key: 1 / depth, of the triangle or of its depth group; >= 0
    Lanes rgba[4];  // finite in every lane, covered or not
};

// Only for depth, normal and attribute outputs.
struct FragmentWeights {
    Lanes z;     // depth
    Lanes b[3];  // barycentric weights, not yet normalised
};

// Receives fragments in any order and emits them front to back at every sample; equal keys are emitted in the
// order of their faces.
//
// Invariants between calls:
// - The first `count_` entries are in use, each with at least one lane.
// - All fragments of an entry belong to faces of one group. `face` is the first of these faces.
// - Entries of one group follow each other in the order of their faces.
// - A lane leaves its entry when its fragment is emitted or its sample is no longer active.
// The caller owns the mask of active lanes, which the emit callbacks may shrink.
class FragmentQueue {
  public:
    int count() const { return count_; }
    // Long enough for drain() to be worth its cost.
    bool full() const { return count_ >= limit_; }
    // Long enough for cull() to be worth its cost.
    bool crowded() const { return count_ >= MANY_ENTRIES; }

    const Fragments &fragments(int entry) const { return fragments_[checked(entry)]; }
    const FragmentWeights &weights(int entry) const { return weights_[checked(entry)]; }

    // The coverage masks [first_mask, first_mask + mask_count) of the tile, see TileCoverage.
    uint32_t first_mask(int entry) const { return entries_[checked(entry)].first_mask; }
    uint32_t mask_count(int entry) const { return entries_[checked(entry)].mask_count; }

    // Index of the entry on the tape, or NOT_RECORDED.
    static constexpr uint32_t NOT_RECORDED = UINT32_MAX;
    uint32_t &tape_index(int entry) { return entries_[checked(entry)].tape_index; }

    // Storage for the fragments of the next entry; push() adds it.
    Fragments &next() {
        if (count_ == (int)entries_.size()) {
            entries_.resize(std::max(32, 2 * count_));
            fragments_.resize(entries_.size());
        }
        return fragments_[count_];
    }
    // Adds the entry in next(). `face` is its first face; `weights` may be null.
    void push(LaneMask covered, int32_t face, const FragmentWeights *weights, uint32_t first_mask,
              uint32_t mask_count) {
        MS_ASSERT(covered && covered <= ALL_LANES);
        MS_ASSERT(count_ < (int)entries_.size());
        MS_ASSERT(greater_equal(fragments_[count_].key, broadcast(0)) == ALL_LANES);
        if (weights) {
            weights_.resize(entries_.size());
            weights_[count_] = *weights;
        }
        entries_[count_++] = {covered, face, first_mask, mask_count, NOT_RECORDED};
    }

    void clear() {
        count_ = 0;
        limit_ = MIN_DRAIN;
    }

    // Emits all fragments with keys > nearest_to_come: nothing that is pushed later can lie in front of them.
    // Calls emit(entry, lanes), which may shrink `active`.
    template <class Emit>
    void drain(float nearest_to_come, const LaneMask &active, Emit &&emit) {
        const Lanes limit = broadcast(nearest_to_come);
        if (pending_.size() < (size_t)count_) pending_.resize(entries_.size());
        int n = 0;
        for (int i = 0; i < count_; ++i) {
            LaneMask ready = entries_[i].lanes & active & greater(fragments_[i].key, limit);
            entries_[i].lanes &= active & ~ready;
            pending_[n] = {i, ready};
            n += ready != 0;
        }
        emit_sorted(n, active, emit);
        compact(active);
    }

    // Removes fragments that are certainly hidden. Calls visible(entry, lanes) like `emit` of drain(), but
    // for all entries, whatever is pushed later; each entry keeps only the lanes that it returns.
    template <class Visible>
    void cull(const LaneMask &active, Visible &&visible) {
        pending_.resize(entries_.size());
        std::vector<LaneMask> kept(count_);
        for (int i = 0; i < count_; ++i) pending_[i] = {i, entries_[i].lanes};
        emit_sorted(count_, active, [&](int entry, LaneMask ready) { kept[entry] |= visible(entry, ready); });
        for (int i = 0; i < count_; ++i) {
            MS_ASSERT(!(kept[i] & ~entries_[i].lanes));
            entries_[i].lanes = kept[i];
        }
        // `active` only simulated what is in the queue: the samples themselves are still active.
        compact(ALL_LANES);
    }

  private:
    static constexpr int MIN_DRAIN = 8;
    static constexpr int MANY_ENTRIES = 256;
    // Largest lists for in_rank_order (unrolled code of more vectors does not pay) and for nearest_first.
    static constexpr int MAX_RANKED = PARTS <= 2 ? 16 : 8, MAX_SEARCHED = 512;
    static_assert(MAX_RANKED <= LANES);

    struct QueueEntry {
        LaneMask lanes;
        int32_t face;
        uint32_t first_mask, mask_count, tape_index;
    };
    // The lanes of an entry that are still to be emitted.
    struct Pending {
        int entry;
        LaneMask lanes;
    };

    int checked(int entry) const {
        MS_ASSERT(entry >= 0 && entry < count_);
        return entry;
    }
    const Lanes &key(int pending) const { return fragments_[pending_[pending].entry].key; }
    int32_t face(int pending) const { return entries_[pending_[pending].entry].face; }

    // Drops inactive lanes, and entries without lanes. Keeps the order of the others.
    void compact(LaneMask active) {
        int kept = 0;
        for (int i = 0; i < count_; ++i) {
            if (!(entries_[i].lanes &= active)) continue;
            if (kept < i) {
                entries_[kept] = entries_[i];
                fragments_[kept] = fragments_[i];
                if (!weights_.empty()) weights_[kept] = weights_[i];
            }
            ++kept;
        }
        count_ = kept;
        // Drain again when the queue has doubled: the total cost stays linear in the number of entries.
        limit_ = std::max(MIN_DRAIN, 2 * count_);
    }

    // Emits the first n pending entries by the method that suits their count.
    template <class Emit>
    void emit_sorted(int n, const LaneMask &active, Emit &&emit) {
        MS_ASSERT(n <= (int)pending_.size());
        if (n > MAX_SEARCHED)
            lane_by_lane(n, active, emit);
        else if (n > MAX_RANKED)
            nearest_first(n, active, emit);
        else if (n > 0)
            in_rank_order(n, emit);
    }

    struct Order {
        Lanes rank[MAX_RANKED];   // by pending entry: its position in the order of each lane
        int pending[MAX_RANKED];  // pending entries by their mean rank
    };

    // Rank sort (comparison counting; Knuth, TAOCP 3, 5.2) of n <= N entries in every lane: the rank of a
    // fragment is the number of fragments in front of it. Lanes that an entry does not cover get distinct
    // negative keys, behind all others.
    template <int N>
    void rank_sort(const int n, Order &order) const {
        Lanes keys[N], rank[N];
        for (int i = 0; i < N; ++i) {
            keys[i] = i < n ? select(pending_[i].lanes, key(i), broadcast(-1.0f - i)) : broadcast(-1.0f - i);
            rank[i] = broadcast(0);
        }
        LaneMask ties = 0;
#pragma GCC unroll 16
        for (int j = 1; j < N; ++j) {
#pragma GCC unroll 16
            for (int i = 0; i < j; ++i) ties |= update_ranks(keys[i], keys[j], rank[i], rank[j]);
        }
        if (ties) break_ties(n, keys, rank);
        order_entries(n, rank, order);
    }

    // update_ranks puts the later of two equal entries in front. Swaps them where the earlier has the lower
    // face.
    void break_ties(const int n, const Lanes *keys, Lanes *rank) const {
        for (int j = 1; j < n; ++j)
            for (int i = 0; i < j; ++i)
                if (face(i) < face(j)) {
                    const LaneMask tie = equal(keys[i], keys[j]);
                    rank[i] = rank[i] - masked(tie, broadcast(1));
                    rank[j] = rank[j] + masked(tie, broadcast(1));
                }
    }

    void order_entries(const int n, const Lanes *rank, Order &order) const {
        alignas(64) float mean[LANES];
        std::fill(mean, mean + LANES, std::numeric_limits<float>::max());
        for (int i = 0; i < n; ++i) {
            order.rank[i] = rank[i];
            mean[i] = sum(masked(pending_[i].lanes, rank[i])) / __builtin_popcount(pending_[i].lanes);
        }
        const Lanes means = load_lanes(mean);
        for (int i = 0; i < n; ++i) {
            const LaneMask in_front =
                greater(broadcast(mean[i]), means) | (equal(broadcast(mean[i]), means) & ((1u << i) - 1));
            order.pending[__builtin_popcount(in_front)] = i;
        }
    }

    // Neighbouring samples nearly always agree on the order of two triangles: mostly, each entry is emitted
    // in one call. Where triangles intersect, an entry is emitted in parts.
    template <class Emit>
    void in_rank_order(const int n, Emit &emit) {
        Order order;
        if (n <= 4)
            rank_sort<4>(n, order);
        else if (n <= 6)
            rank_sort<6>(n, order);
        else if (n <= 8)
            rank_sort<8>(n, order);
        else if constexpr (MAX_RANKED > 8)
            n <= 12 ? rank_sort<12>(n, order) : rank_sort<16>(n, order);
        Lanes emitted = broadcast(0);  // number of fragments emitted in each lane
        // Each pass emits at least the next fragment of one lane. Bit i of `left`: order.pending[i] has lanes
        // left.
        for (uint32_t left = (1u << n) - 1; left;) {
            for (uint32_t rest = left; rest; rest &= rest - 1) {
                const int position = __builtin_ctz(rest), i = order.pending[position];
                Pending &p = pending_[i];
                const LaneMask due = p.lanes & equal(order.rank[i], emitted);
                if (due) emit(p.entry, due);
                emitted = emitted + masked(due, broadcast(1));
                p.lanes &= ~due;
                left &= ~((uint32_t)!p.lanes << position);
            }
        }
    }

    // Selection sort in every lane, for lists of which mostly only the nearest fragments are visible.
    template <class Emit>
    void nearest_first(int n, const LaneMask &active, Emit &emit) {
        constexpr float NONE = -1, DONE = -2;
        constexpr int ROUNDS_PER_COMPACTION = 8;
        if (left_keys_.size() < (size_t)n) left_keys_.resize(n);
        for (int i = 0; i < n; ++i) left_keys_[i] = select(pending_[i].lanes, key(i), broadcast(DONE));
        for (int round = 1;; ++round) {
            Lanes nearest = broadcast(NONE), nearest_index = broadcast(0);
            int32_t last_face = face(0);  // highest so far
            for (int i = 0; i < n; ++i) {
                const LaneMask ties = equal(left_keys_[i], nearest);
                keep_greater(left_keys_[i], broadcast((float)i), nearest, nearest_index);
                // Entries mostly come in the order of their faces.
                if (ties && face(i) < last_face) keep_lower_face(i, ties, nearest_index);
                last_face = std::max(last_face, face(i));
            }
            LaneMask rest = active & greater(nearest, broadcast(NONE));
            if (!rest) return;
            alignas(64) float indices[LANES];
            store_lanes(indices, nearest_index);
            while (rest) {
                const float index = indices[__builtin_ctz(rest)];
                const int i = (int)index;
                const LaneMask due = rest & equal(nearest_index, broadcast(index));
                MS_ASSERT(i >= 0 && i < n && !(due & ~pending_[i].lanes));
                left_keys_[i] = select(due, broadcast(DONE), left_keys_[i]);
                pending_[i].lanes &= ~due;
                emit(pending_[i].entry, due);
                rest &= ~due;
            }
            if (round % ROUNDS_PER_COMPACTION) continue;
            // Compact away finished entries.
            int kept = 0;
            for (int i = 0; i < n; ++i) {
                pending_[kept] = pending_[i];
                left_keys_[kept] = left_keys_[i];
                kept += (pending_[i].lanes & active) != 0;
            }
            n = kept;
        }
    }

    // In the lanes `ties`, replaces the index by i where entry i has the lower face.
    void keep_lower_face(int i, LaneMask ties, Lanes &indices) const {
        alignas(64) float index[LANES];
        store_lanes(index, indices);
        for (; ties; ties &= ties - 1) {
            float &other = index[__builtin_ctz(ties)];
            if (face(i) < face((int)other)) other = (float)i;
        }
        indices = load_lanes(index);
    }

    struct LaneFragment {
        float key;
        int32_t face;
        int entry;
        bool operator<(const LaneFragment &other) const {
            return key != other.key ? key > other.key : face < other.face;
        }
    };

    // The first n pending entries that cover a lane, nearest first.
    void sort_lane(const int n, const int lane, std::vector<LaneFragment> &list) const {
        list.clear();
        for (int i = 0; i < n; ++i)
            if (pending_[i].lanes & (1u << lane))
                list.push_back({lane_of(key(i), lane), face(i), pending_[i].entry});
        std::sort(list.begin(), list.end());
    }

    // Sorts the list of each lane on its own, for very long lists.
    template <class Emit>
    void lane_by_lane(const int n, const LaneMask &active, Emit &emit) {
        std::vector<LaneFragment> list;
        for (int lane = 0; lane < LANES; ++lane) {
            const LaneMask bit = 1u << lane;
            sort_lane(n, lane, list);
            for (const LaneFragment &f : list) {
                if (!(active & bit)) break;
                emit(f.entry, bit);
            }
        }
    }

    // Vectors only grow: the first `count_` elements are in use. weights_ stays empty if no entry has
    // weights.
    std::vector<QueueEntry> entries_;
    std::vector<Fragments> fragments_;
    std::vector<FragmentWeights> weights_;
    std::vector<Pending> pending_;
    std::vector<Lanes> left_keys_;  // of nearest_first: keys of pending fragments
    int count_ = 0;
    int limit_ = MIN_DRAIN;  // the length from which the queue is full
};

}  // namespace ms
