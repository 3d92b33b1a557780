// Gaussians merged pair by pair, the cheapest pair first, and the search for their neighbours.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "large.h"
#include "parallel.h"

extern "C" {

struct MsNearest {
    int64_t count;
    int32_t neighbours, threads;  // neighbours: at most count - 1
    const double *points;         // xyz
    int32_t *order;               // (count,): the points sorted so that neighbours lie close to each other
    int32_t *nearest;  // (count, neighbours): of point order[i], as places in that order, nearest first
};

struct MsMerging {
    int64_t count, wanted;
    int32_t neighbours, threads;
    const double *means;        // xyz
    const double *covariances;  // xx xy xz yy yz zz
    const double *masses;
    const double *colors;    // RGB
    const int32_t *nearest;  // (count, neighbours)
    double color_weight;
    int32_t *group;  // (count,): the lowest number of those that became one
    int64_t left;    // groups: more than wanted if no neighbours are left to be merged
};

}  // extern "C"

namespace ms {

// A k-d tree over points: cells halved across their longest side until few points are left in each.
class PointTree {
  public:
    static constexpr int FEW = 8;

    PointTree(const double *points, int64_t count, int32_t *order) : order_(order), places_(count) {
        for (int64_t i = 0; i < count; ++i) order[i] = (int32_t)i;
        for (int64_t cells = 1; count / cells > FEW; cells *= 2) levels_++;
        cells_.resize((std::size_t)1 << levels_);
        divide(points, 0, count, 1, 0);
        for (int64_t i = 0; i < count; ++i)
            places_[i] = {points[3 * order[i]], points[3 * order[i] + 1], points[3 * order[i] + 2]};
    }

    // The nearest of the points to the one at `place`, itself left out; equally near ones in the tree's
    // order.
    void nearest(int32_t place, int32_t *out, double *distances, int count) const {
        std::fill_n(distances, count, std::numeric_limits<double>::infinity());
        double outside[3] = {0, 0, 0};
        search(0, (int64_t)places_.size(), 1, 0, places_[place], place, 0, outside, out, distances, count);
    }

  private:
    struct Point {
        double at[3];
    };
    struct Cell {
        int axis;
        double border;
    };

    void divide(const double *points, int64_t begin, int64_t end, std::size_t cell, int level) {
        if (level == levels_) return;
        double low[3], high[3];
        for (int k = 0; k < 3; ++k) low[k] = std::numeric_limits<double>::infinity(), high[k] = -low[k];
        for (int64_t i = begin; i < end; ++i)
            for (int k = 0; k < 3; ++k) {
                const double x = points[3 * (int64_t)order_[i] + k];
                low[k] = std::min(low[k], x);
                high[k] = std::max(high[k], x);
            }
        int axis = 0;
        for (int k = 1; k < 3; ++k)
            if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
        const int64_t middle = (begin + end) / 2;
        std::nth_element(order_ + begin, order_ + middle, order_ + end, [&](int32_t a, int32_t b) {
            const double x = points[3 * (int64_t)a + axis], y = points[3 * (int64_t)b + axis];
            return x < y || (x == y && a < b);
        });
        cells_[cell] = {axis, points[3 * (int64_t)order_[middle] + axis]};
        divide(points, begin, middle, 2 * cell, level + 1);
        divide(points, middle, end, 2 * cell + 1, level + 1);
    }

    // `outside`: how far the query lies outside the cell along each axis, `square` the sum of their squares.
    void search(int64_t begin, int64_t end, std::size_t cell, int level, const Point &query, int32_t self,
                double square, double *outside, int32_t *out, double *distances, int count) const {
        if (level == levels_) {
            for (int64_t i = begin; i < end; ++i) {
                if (i == self) continue;
                const double x = places_[i].at[0] - query.at[0], y = places_[i].at[1] - query.at[1],
                             z = places_[i].at[2] - query.at[2];
                insert((int32_t)i, x * x + y * y + z * z, out, distances, count);
            }
            return;
        }
        const int64_t middle = (begin + end) / 2;
        const int axis = cells_[cell].axis;
        const double across = query.at[axis] - cells_[cell].border;
        const bool upper = across >= 0;
        auto descend = [&](bool up, double distance) {
            search(up ? middle : begin, up ? end : middle, 2 * cell + up, level + 1, query, self, distance,
                   outside, out, distances, count);
        };
        descend(upper, square);
        const double before = outside[axis], further = square - before * before + across * across;
        // A little less: rounding must not leave out one that is as near.
        if (further * (1 - 1e-12) > distances[count - 1]) return;
        outside[axis] = across;
        descend(!upper, further);
        outside[axis] = before;
    }

    static void insert(int32_t number, double distance, int32_t *out, double *distances, int count) {
        auto after = [&](int i) {
            return distance < distances[i] || (distance == distances[i] && number < out[i]);
        };
        int i = count - 1;
        if (!after(i)) return;
        for (; i > 0 && after(i - 1); --i) distances[i] = distances[i - 1], out[i] = out[i - 1];
        distances[i] = distance;
        out[i] = number;
    }

    int32_t *order_;
    int levels_ = 0;
    std::vector<Cell> cells_;  // of cell c, halves are 2 c and 2 c + 1
    Large<Point> places_;
};

inline void find_nearest(const MsNearest &n) {
    const PointTree tree(n.points, n.count, n.order);
    parallel_blocks(n.threads, n.count, 1024, [&](int64_t begin, int64_t end, int) {
        std::vector<double> distances(n.neighbours);
        for (int64_t i = begin; i < end; ++i) {
            std::fill_n(n.nearest + i * n.neighbours, n.neighbours, std::numeric_limits<int32_t>::max());
            tree.nearest((int32_t)i, n.nearest + i * n.neighbours, distances.data(), n.neighbours);
        }
    });
}

// Merges pairs of neighbours, always the pair whose merging costs least, until as many are left as are
// wanted.
//
// The cost is Runnalls' bound on the information lost by a merged pair (IEEE Trans. Aerospace 43, 2007, eq.
// 16), with the mean area of the projections in place of the volume, and the variance of the colours beside
// it:
//     m/2 log e(S) - ma/2 log e(Sa) - mb/2 log e(Sb) + color_weight ma mb / m |ca - cb|^2,
// with masses m = ma + mb and e the sum of the products of two variances each, whose root is that area but
// for a factor.
class Merging {
  public:
    explicit Merging(const MsMerging &given)
        : given_(given), splats_(given.count), owner_(given.count), best_(given.count), lists_(given.count) {
        const int64_t n = given.count;
        for (int64_t i = 0; i < n; ++i) {
            Splat &s = splats_[i];
            std::copy_n(given.means + 3 * i, 3, s.mean);
            std::copy_n(given.covariances + 6 * i, 6, s.covariance);
            std::copy_n(given.colors + 3 * i, 3, s.color);
            s.mass = given.masses[i];
            s.half_log = half_log(s.covariance);
            owner_[i] = (int32_t)i;
            best_[i] = {0, -1, 0, 0};
        }
        link();
    }

    // Numbers of those that each became part of, the lowest of them; returns how many are left.
    int64_t run(int32_t *group) {
        const int64_t n = given_.count;
        parallel_blocks(given_.threads, n, 1024, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i) best_[i] = cheapest((int32_t)i);
        });
        for (int64_t i = 0; i < n; ++i)
            if (best_[i].partner >= 0) queue_.push_back({best_[i].cost, (int32_t)i, 0});
        std::make_heap(queue_.begin(), queue_.end());
        int64_t left = n;
        while (left > given_.wanted && !queue_.empty()) {
            std::pop_heap(queue_.begin(), queue_.end());
            const Entry entry = queue_.back();
            queue_.pop_back();
            const int32_t a = entry.splat;
            if (owner_[a] != a || entry.version != best_[a].version) continue;
            const int32_t b = best_[a].partner;
            // Merging makes neighbours dearer: what is out of date comes too early, and is put back.
            if (owner_[b] != b || splats_[b].merged != best_[a].partner_merged) {
                tidy(a);
                set_best(a, cheapest(a));
                continue;
            }
            merge(std::min(a, b), std::max(a, b));
            --left;
            if ((int64_t)queue_.size() > 4 * n) forget_stale();
        }
        for (int64_t i = 0; i < n; ++i) group[i] = find((int32_t)i);
        return left;
    }

  private:
    static constexpr int MOST = 24;  // neighbours of a merged splat, of which the dearest are forgotten

    struct Splat {
        double mean[3], covariance[6], color[3], mass, half_log;
        int32_t merged = 0;  // times
    };
    struct Best {
        double cost;
        int32_t partner, partner_merged, version;
    };
    struct Entry {
        double cost;
        int32_t splat, version;
        bool operator<(const Entry &other) const {  // the cheapest on top
            return cost != other.cost ? cost > other.cost : splat > other.splat;
        }
    };
    struct List {
        int64_t begin;
        int32_t length, space;
    };

    static double half_log(const double *c) {
        const double area = c[0] * c[3] + c[0] * c[5] + c[3] * c[5] - c[1] * c[1] - c[2] * c[2] - c[4] * c[4];
        return 0.5 * std::log(std::max(area, 1e-300));
    }

    // Moments of both together; of two without mass, those of the first.
    static Splat together(const Splat &a, const Splat &b) {
        Splat s;
        s.mass = a.mass + b.mass;
        const double wb = s.mass > 0 ? b.mass / s.mass : 0, wa = 1 - wb;
        double apart[3];
        for (int k = 0; k < 3; ++k) {
            apart[k] = b.mean[k] - a.mean[k];
            s.mean[k] = a.mean[k] + wb * apart[k];
            s.color[k] = wa * a.color[k] + wb * b.color[k];
        }
        for (int i = 0, k = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++k)
                s.covariance[k] =
                    wa * a.covariance[k] + wb * b.covariance[k] + wa * wb * (apart[i] * apart[j]);
        s.half_log = half_log(s.covariance);
        return s;
    }

    double cost(int32_t first, int32_t second) const {
        const Splat &a = splats_[std::min(first, second)], &b = splats_[std::max(first, second)];
        const Splat s = together(a, b);
        if (!(s.mass > 0)) return 0;
        double color = 0;
        for (int k = 0; k < 3; ++k) color += (a.color[k] - b.color[k]) * (a.color[k] - b.color[k]);
        const double spread = a.mass * (s.half_log - a.half_log) + b.mass * (s.half_log - b.half_log);
        return std::max(spread, 0.0) + given_.color_weight * (a.mass * b.mass / s.mass) * color;
    }

    // Neighbours are so on both sides.
    void link() {
        const int64_t n = given_.count;
        const int32_t k = given_.neighbours;
        Large<int32_t> counts(n, 0);
        auto each = [&](auto body) {
            for (int64_t i = 0; i < n; ++i)
                for (int32_t j = 0; j < k; ++j) {
                    const int32_t other = given_.nearest[i * k + j];
                    if (other < 0 || other >= n || other == i)
                        throw std::invalid_argument("neighbour " + std::to_string(other) + " of " +
                                                    std::to_string(i) + " is not another of " +
                                                    std::to_string(n));
                    const int32_t *back = given_.nearest + (int64_t)other * k;
                    body((int32_t)i, other);
                    if (std::find(back, back + k, (int32_t)i) == back + k) body(other, (int32_t)i);
                }
        };
        each([&](int32_t from, int32_t) { ++counts[from]; });
        int64_t total = 0;
        for (int64_t i = 0; i < n; ++i) {
            lists_[i] = {total, 0, counts[i]};
            total += counts[i];
        }
        links_.resize(total);
        each([&](int32_t from, int32_t to) { links_[lists_[from].begin + lists_[from].length++] = to; });
    }

    int32_t find(int32_t i) {
        while (owner_[i] != i) {
            owner_[i] = owner_[owner_[i]];
            i = owner_[i];
        }
        return i;
    }

    // Neighbours of `a` that were merged are replaced by what they became, each once.
    void tidy(int32_t a) {
        List &list = lists_[a];
        int32_t *begin = links_.data() + list.begin, *end = begin + list.length;
        for (int32_t *i = begin; i < end; ++i) *i = find(*i);
        std::sort(begin, end);
        end = std::remove(begin, std::unique(begin, end), a);
        list.length = (int32_t)(end - begin);
    }

    Best cheapest(int32_t a) const {
        Best best{std::numeric_limits<double>::infinity(), -1, 0, best_[a].version};
        const List &list = lists_[a];
        for (int32_t i = 0; i < list.length; ++i) {
            const int32_t other = links_[list.begin + i];
            const double found = cost(a, other);
            if (found < best.cost || (found == best.cost && other < best.partner))
                best.cost = found, best.partner = other;
        }
        if (best.partner >= 0) best.partner_merged = splats_[best.partner].merged;
        return best;
    }

    void set_best(int32_t a, const Best &best) {
        const int32_t version = best_[a].version + 1;
        best_[a] = best;
        best_[a].version = version;
        if (best.partner < 0) return;
        queue_.push_back({best.cost, a, version});
        std::push_heap(queue_.begin(), queue_.end());
    }

    void merge(int32_t a, int32_t b) {
        const int32_t merged = splats_[a].merged + 1;
        splats_[a] = together(splats_[a], splats_[b]);
        splats_[a].merged = merged;
        owner_[b] = a;

        around_.clear();
        for (int32_t from : {a, b})
            for (int32_t i = 0; i < lists_[from].length; ++i) {
                const int32_t other = find(links_[lists_[from].begin + i]);
                if (other != a) around_.push_back({0, other});
            }
        auto by_number = [](const auto &x, const auto &y) { return x.second < y.second; };
        auto same = [](const auto &x, const auto &y) { return x.second == y.second; };
        std::sort(around_.begin(), around_.end(), by_number);
        around_.erase(std::unique(around_.begin(), around_.end(), same), around_.end());
        for (auto &[price, other] : around_) price = cost(a, other);
        if (around_.size() > MOST) {
            std::nth_element(around_.begin(), around_.begin() + MOST, around_.end());
            around_.resize(MOST);
        }
        keep_list(a, b);
        // A pair of it that is cheaper than its neighbour's best is found from this side.
        Best best{std::numeric_limits<double>::infinity(), -1, 0, 0};
        for (const auto &[price, other] : around_) {
            if (price < best.cost || (price == best.cost && other < best.partner))
                best = {price, other, splats_[other].merged, 0};
        }
        set_best(a, best);
    }

    // Those in around_ as the list of `a`: in the longer of both lists' places if they fit, else in a new
    // one.
    void keep_list(int32_t a, int32_t b) {
        const int32_t length = (int32_t)around_.size();
        List place = lists_[a].space >= lists_[b].space ? lists_[a] : lists_[b];
        if (length > place.space) {
            place.begin = (int64_t)links_.size();
            place.space = MOST;
            links_.resize(links_.size() + MOST);
        }
        place.length = length;
        for (int32_t i = 0; i < length; ++i) links_[place.begin + i] = around_[i].second;
        lists_[a] = place;
        lists_[b] = {0, 0, 0};
    }

    void forget_stale() {
        auto stale = [&](const Entry &e) {
            return owner_[e.splat] != e.splat || e.version != best_[e.splat].version;
        };
        queue_.erase(std::remove_if(queue_.begin(), queue_.end(), stale), queue_.end());
        std::make_heap(queue_.begin(), queue_.end());
    }

    const MsMerging &given_;
    Large<Splat> splats_;
    Large<int32_t> owner_;  // itself, or one that it was merged into
    Large<Best> best_;
    Large<List> lists_;
    Large<int32_t> links_;
    std::vector<Entry> queue_;
    std::vector<std::pair<double, int32_t>> around_;
};

inline void merge_pairs(MsMerging &given) {
    Merging merging(given);
    given.left = merging.run(given.group);
}

}  // namespace ms
