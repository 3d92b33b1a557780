// Greedy pairwise merging of Gaussians.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "parallel.h"
#include "pooled_vector.h"

extern "C" {

struct MsMerging {
    int64_t count, wanted;
    int32_t neighbours, threads;
    const double *means;        // (count, 3)
    const double *covariances;  // (count, 6): xx xy xz yy yz zz
    const double *masses;       // (count,)
    const double *colors;       // (count, 3) RGB
    const int32_t *nearest;     // (count, neighbours) indices
    double color_weight;
    int32_t *group;     // out: (count,) the lowest index in the group that each became part of
    int64_t remaining;  // out: number of groups; more than wanted if neighbours ran out
};

}  // extern "C"

namespace ms {

// Merges the pair of neighbours with the lowest cost until `wanted` splats are left.
//
// The cost is Runnalls' bound on the information that merging a pair loses (IEEE Trans. Aerospace and
// Electronic Systems 43, 2007, eq. 16), with the mean area of the projections in place of the volume, plus
// the variance of the colours:
//     m/2 log e(S) - ma/2 log e(Sa) - mb/2 log e(Sb) + color_weight ma mb / m |ca - cb|^2,
// with masses m = ma + mb and e(S) the second elementary symmetric polynomial of the variances (principal
// minors of S summed); up to a factor, its square root is that area.
//
// Each splat keeps its cheapest partner in a heap. Entries are not updated but checked when they come to the
// top: an outdated one is dropped or replaced. That is correct because merging makes neighbours more
// expensive, so an outdated entry comes too early, never too late.
class Merging {
  public:
    explicit Merging(const MsMerging &input)
        : input_(input), splats_(input.count), parent_(input.count), best_(input.count), lists_(input.count) {
        const int64_t n = input.count;
        MS_ASSERT(n >= 0 && n <= INT32_MAX && input.wanted >= 1 && input.neighbours >= 0);
        for (int64_t i = 0; i < n; ++i) {
            MS_ASSERT(input.masses[i] >= 0);
            Splat &s = splats_[i];
            std::copy_n(input.means + 3 * i, 3, s.mean);
            std::copy_n(input.covariances + 6 * i, 6, s.covariance);
            std::copy_n(input.colors + 3 * i, 3, s.color);
            s.mass = input.masses[i];
            s.half_log_area = half_log_area(s.covariance);
            parent_[i] = (int32_t)i;
            best_[i] = {0, NONE, 0, 0};
        }
        link_neighbours();
    }

    // Writes the lowest index of its group for each splat, (count,); returns the number of groups.
    int64_t run(int32_t *group) {
        const int64_t n = input_.count;
        parallel_blocks(input_.threads, n, 1024, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i) best_[i] = cheapest_partner((int32_t)i);
        });
        for (int64_t i = 0; i < n; ++i)
            if (best_[i].partner != NONE) heap_.push_back({best_[i].cost, (int32_t)i, 0});
        std::make_heap(heap_.begin(), heap_.end());
        int64_t remaining = n;
        while (remaining > input_.wanted && !heap_.empty()) {
            stop_point();
            std::pop_heap(heap_.begin(), heap_.end());
            const HeapEntry entry = heap_.back();
            heap_.pop_back();
            if (is_outdated(entry)) continue;
            const int32_t a = entry.splat, b = best_[a].partner;
            if (!is_root(b) || splats_[b].merges != best_[a].partner_merges) {
                update_neighbours(a);
                set_best(a, cheapest_partner(a));
                continue;
            }
            merge(std::min(a, b), std::max(a, b));
            --remaining;
            if ((int64_t)heap_.size() > MAX_HEAP_RATIO * n) drop_outdated();
        }
        for (int64_t i = 0; i < n; ++i) group[i] = find_root((int32_t)i);
        return remaining;
    }

  private:
    static constexpr int32_t NONE = -1;
    static constexpr int MAX_NEIGHBOURS = 24;  // of a merged splat: the cheapest ones
    static constexpr int64_t MAX_HEAP_RATIO = 4;

    struct Splat {
        double mean[3], covariance[6], color[3], mass, half_log_area;
        int32_t merges = 0;  // number of merges that made this splat
    };
    struct Best {
        double cost;
        int32_t partner;  // or NONE
        int32_t partner_merges;
        int32_t version;  // counts the changes: older heap entries are outdated
    };
    struct HeapEntry {
        double cost;
        int32_t splat, version;
        bool operator<(const HeapEntry &other) const {  // std heaps have the greatest on top: the cheapest
            return cost != other.cost ? cost > other.cost : splat > other.splat;
        }
    };
    struct NeighbourList {
        int64_t begin;  // in links_
        int32_t length, capacity;
    };

    // log e(S) / 2, see above.
    static double half_log_area(const double *c) {
        const double area = c[0] * c[3] + c[0] * c[5] + c[3] * c[5] - c[1] * c[1] - c[2] * c[2] - c[4] * c[4];
        return 0.5 * std::log(std::max(area, 1e-300));
    }

    // Moment matching: mass, mean, covariance and mean colour of both. If both have no mass, those of the
    // first.
    static Splat moments(const Splat &a, const Splat &b) {
        Splat s;
        s.mass = a.mass + b.mass;
        const double wb = s.mass > 0 ? b.mass / s.mass : 0, wa = 1 - wb;
        double delta[3];
        for (int k = 0; k < 3; ++k) {
            delta[k] = b.mean[k] - a.mean[k];
            s.mean[k] = a.mean[k] + wb * delta[k];
            s.color[k] = wa * a.color[k] + wb * b.color[k];
        }
        for (int i = 0, k = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++k)
                s.covariance[k] =
                    wa * a.covariance[k] + wb * b.covariance[k] + wa * wb * (delta[i] * delta[j]);
        s.half_log_area = half_log_area(s.covariance);
        return s;
    }

    // Symmetric to the last bit.
    double cost(int32_t first, int32_t second) const {
        const Splat &a = splats_[std::min(first, second)], &b = splats_[std::max(first, second)];
        const Splat s = moments(a, b);
        if (!(s.mass > 0)) return 0;
        double color = 0;
        for (int k = 0; k < 3; ++k) color += (a.color[k] - b.color[k]) * (a.color[k] - b.color[k]);
        const double growth =
            a.mass * (s.half_log_area - a.half_log_area) + b.mass * (s.half_log_area - b.half_log_area);
        return std::max(growth, 0.0) + input_.color_weight * (a.mass * b.mass / s.mass) * color;
    }

    // Makes the neighbour relation symmetric and stores it as lists. Throws if an index is out of range.
    void link_neighbours() {
        const int64_t n = input_.count;
        const int32_t k = input_.neighbours;
        PooledVector<int32_t> counts(n, 0);
        auto for_each_link = [&](auto body) {
            for (int64_t i = 0; i < n; ++i)
                for (int32_t j = 0; j < k; ++j) {
                    const int32_t other = input_.nearest[i * k + j];
                    if (other < 0 || other >= n || other == i)
                        throw std::invalid_argument("neighbour " + std::to_string(other) + " of " +
                                                    std::to_string(i) + " is not another of " +
                                                    std::to_string(n));
                    body((int32_t)i, other);
                    const int32_t *others = input_.nearest + (int64_t)other * k;
                    if (std::find(others, others + k, (int32_t)i) == others + k) body(other, (int32_t)i);
                }
        };
        for_each_link([&](int32_t from, int32_t) { ++counts[from]; });
        int64_t total = 0;
        for (int64_t i = 0; i < n; ++i) {
            lists_[i] = {total, 0, counts[i]};
            total += counts[i];
        }
        links_.resize(total);
        for_each_link(
            [&](int32_t from, int32_t to) { links_[lists_[from].begin + lists_[from].length++] = to; });
    }

    // Union-find with path halving. The root of a group is its lowest index.
    bool is_root(int32_t i) const { return parent_[i] == i; }
    int32_t find_root(int32_t i) {
        while (!is_root(i)) {
            parent_[i] = parent_[parent_[i]];
            i = parent_[i];
        }
        return i;
    }

    // Replaces merged neighbours of `a` by their groups, each once.
    void update_neighbours(int32_t a) {
        NeighbourList &list = lists_[a];
        int32_t *begin = links_.data() + list.begin, *end = begin + list.length;
        for (int32_t *i = begin; i < end; ++i) *i = find_root(*i);
        std::sort(begin, end);
        end = std::remove(begin, std::unique(begin, end), a);
        list.length = (int32_t)(end - begin);
    }

    // Of equal costs the partner with the lowest index.
    Best cheapest_partner(int32_t a) const {
        Best best{std::numeric_limits<double>::infinity(), NONE, 0, best_[a].version};
        const NeighbourList &list = lists_[a];
        for (int32_t i = 0; i < list.length; ++i) {
            const int32_t other = links_[list.begin + i];
            const double price = cost(a, other);
            if (price < best.cost || (price == best.cost && other < best.partner))
                best.cost = price, best.partner = other;
        }
        if (best.partner != NONE) best.partner_merges = splats_[best.partner].merges;
        return best;
    }

    void set_best(int32_t a, const Best &best) {
        const int32_t version = best_[a].version + 1;
        best_[a] = best;
        best_[a].version = version;
        if (best.partner == NONE) return;
        heap_.push_back({best.cost, a, version});
        std::push_heap(heap_.begin(), heap_.end());
    }

    // Merges b into a.
    void merge(int32_t a, int32_t b) {
        MS_ASSERT(a < b && is_root(a) && is_root(b));
        const int32_t merges = splats_[a].merges + 1;
        splats_[a] = moments(splats_[a], splats_[b]);
        splats_[a].merges = merges;
        parent_[b] = a;
        collect_neighbours(a, b);
        store_neighbours(a, b);
        // Neighbours for which the merged splat is the cheapest partner need no update: it has the pair in
        // its own entry.
        Best best{std::numeric_limits<double>::infinity(), NONE, 0, 0};
        for (const auto &[price, other] : neighbours_) {
            if (price < best.cost || (price == best.cost && other < best.partner))
                best = {price, other, splats_[other].merges, 0};
        }
        set_best(a, best);
    }

    // Fills neighbours_ with the cheapest neighbours of both, each once.
    void collect_neighbours(int32_t a, int32_t b) {
        neighbours_.clear();
        for (int32_t from : {a, b})
            for (int32_t i = 0; i < lists_[from].length; ++i) {
                const int32_t other = find_root(links_[lists_[from].begin + i]);
                if (other != a) neighbours_.push_back({0, other});
            }
        auto by_index = [](const auto &x, const auto &y) { return x.second < y.second; };
        auto same = [](const auto &x, const auto &y) { return x.second == y.second; };
        std::sort(neighbours_.begin(), neighbours_.end(), by_index);
        neighbours_.erase(std::unique(neighbours_.begin(), neighbours_.end(), same), neighbours_.end());
        for (auto &[price, other] : neighbours_) price = cost(a, other);
        if (neighbours_.size() > MAX_NEIGHBOURS) {
            std::nth_element(neighbours_.begin(), neighbours_.begin() + MAX_NEIGHBOURS, neighbours_.end());
            neighbours_.resize(MAX_NEIGHBOURS);
        }
    }

    // Stores neighbours_ as the list of a, in the larger of both lists' space if they fit, else in new space.
    void store_neighbours(int32_t a, int32_t b) {
        const int32_t length = (int32_t)neighbours_.size();
        NeighbourList list = lists_[a].capacity >= lists_[b].capacity ? lists_[a] : lists_[b];
        if (length > list.capacity) {
            list.begin = (int64_t)links_.size();
            list.capacity = MAX_NEIGHBOURS;
            links_.resize(links_.size() + MAX_NEIGHBOURS);
        }
        list.length = length;
        for (int32_t i = 0; i < length; ++i) links_[list.begin + i] = neighbours_[i].second;
        lists_[a] = list;
        lists_[b] = {0, 0, 0};
    }

    bool is_outdated(const HeapEntry &entry) const {
        return !is_root(entry.splat) || entry.version != best_[entry.splat].version;
    }
    void drop_outdated() {
        auto outdated = [&](const HeapEntry &entry) { return is_outdated(entry); };
        heap_.erase(std::remove_if(heap_.begin(), heap_.end(), outdated), heap_.end());
        std::make_heap(heap_.begin(), heap_.end());
    }

    const MsMerging &input_;
    PooledVector<Splat> splats_;
    PooledVector<int32_t> parent_;  // union-find: itself, or a splat that it was merged into
    PooledVector<Best> best_;
    PooledVector<NeighbourList> lists_;
    PooledVector<int32_t> links_;
    std::vector<HeapEntry> heap_;
    std::vector<std::pair<double, int32_t>> neighbours_;  // cost and index; scratch of merge
};

inline void merge_pairs(MsMerging &input) {
    Merging merging(input);
    input.remaining = merging.run(input.group);
}

}  // namespace ms
