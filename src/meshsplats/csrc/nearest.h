// The nearest neighbours of points.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "parallel.h"
#include "pooled_vector.h"

extern "C" {

struct MsNearest {
    int64_t count;
    int32_t neighbours, threads;  // neighbours: at most count - 1
    const double *points;         // (count, 3)
    int32_t *order;               // out: (count,) a permutation of the points that is coherent in space
    int32_t *nearest;  // out: (count, neighbours) positions in `order` of the points nearest to order[i],
                       // nearest first
};

}  // extern "C"

namespace ms {

// A balanced k-d tree (Bentley 1975): cells are split at the median along their longest side. Cell c has the
// halves 2 c and 2 c + 1; the root is cell 1. Each cell is a range of the sorted points.
class KdTree {
  public:
    // Writes the permutation that sorts the points into cells to `order`, (count,).
    KdTree(const double *points, int64_t count, int32_t *order) : order_(order), sorted_(count) {
        MS_ASSERT(count >= 0 && count <= INT32_MAX);
        for (int64_t i = 0; i < count; ++i) order[i] = (int32_t)i;
        for (int64_t cells = 1; count / cells > LEAF_SIZE; cells *= 2) levels_++;
        cells_.resize((std::size_t)1 << levels_);
        split(points, 0, count, 1, 0);
        for (int64_t i = 0; i < count; ++i)
            sorted_[i] = {points[3 * order[i]], points[3 * order[i] + 1], points[3 * order[i] + 2]};
    }

    // The `count` points nearest to the sorted point `self`, except itself, as indices of sorted points and
    // squared distances, ascending; of equal distances the lower index first. `nearest` must hold INT32_MAX.
    void find_nearest(int32_t self, int32_t *nearest, double *distances, int count) const {
        MS_ASSERT(self >= 0 && self < (int64_t)sorted_.size() && count >= 1);
        std::fill_n(distances, count, std::numeric_limits<double>::infinity());
        Search search{sorted_[self], self, {0, 0, 0}, nearest, distances, count};
        visit(0, (int64_t)sorted_.size(), 1, 0, 0, search);
    }

  private:
    static constexpr int LEAF_SIZE = 8;

    struct Point {
        double at[3];
    };
    struct Cell {
        int axis;
        bool point;  // all its points lie in one place, at the border
        double border;
    };
    struct Search {
        Point query;
        int32_t self;
        double outside[3];  // distance from the query to the current cell along each axis
        int32_t *nearest;   // the best so far
        double *distances;
        int count;

        // Inserts a point by insertion sort, if it is among the nearest; whether it is.
        bool insert(int32_t index, double distance) {
            auto comes_before = [&](int i) {
                return distance < distances[i] || (distance == distances[i] && index < nearest[i]);
            };
            int i = count - 1;
            if (!comes_before(i)) return false;
            for (; i > 0 && comes_before(i - 1); --i)
                distances[i] = distances[i - 1], nearest[i] = nearest[i - 1];
            distances[i] = distance;
            nearest[i] = index;
            return true;
        }
    };

    void split(const double *points, int64_t begin, int64_t end, std::size_t cell, int level) {
        if (level == levels_) return;
        stop_point();
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
        const bool point = !(high[axis] > low[axis]);
        cells_[cell] = {axis, point, points[3 * (int64_t)order_[middle] + axis]};
        split(points, begin, middle, 2 * cell, level + 1);
        split(points, middle, end, 2 * cell + 1, level + 1);
    }

    static double square_distance(const Point &a, const Point &b) {
        const double x = a.at[0] - b.at[0], y = a.at[1] - b.at[1], z = a.at[2] - b.at[2];
        return x * x + y * y + z * z;
    }

    // Visits a cell whose squared distance to the query is `distance`: first the half that holds the query,
    // then the other one if it may hold a point that is near enough (incremental distances, Arya & Mount
    // 1993).
    void visit(int64_t begin, int64_t end, std::size_t cell, int level, double distance,
               Search &search) const {
        const Point &query = search.query;
        if (level == levels_) {
            for (int64_t i = begin; i < end; ++i)
                if (i != search.self) search.insert((int32_t)i, square_distance(sorted_[i], query));
            return;
        }
        if (cells_[cell].point) {  // which has no nearer half
            const double same = square_distance(sorted_[begin], query);
            for (int64_t i = begin; i < end; ++i)
                if (i != search.self && !search.insert((int32_t)i, same)) return;
            return;
        }
        const int64_t middle = (begin + end) / 2;
        const int axis = cells_[cell].axis;
        const double across = query.at[axis] - cells_[cell].border;
        const bool upper = across >= 0;
        auto descend = [&](bool up, double half_distance) {
            visit(up ? middle : begin, up ? end : middle, 2 * cell + up, level + 1, half_distance, search);
        };
        descend(upper, distance);
        const double before = search.outside[axis], further = distance - before * before + across * across;
        // The margin keeps rounding from missing a point at an equal distance.
        if (further * (1 - 1e-12) > search.distances[search.count - 1]) return;
        search.outside[axis] = across;
        descend(!upper, further);
        search.outside[axis] = before;
    }

    int32_t *order_;
    int levels_ = 0;
    std::vector<Cell> cells_;
    PooledVector<Point> sorted_;
};

inline void find_nearest(const MsNearest &n) {
    MS_ASSERT(n.neighbours >= 1 && n.neighbours < n.count);
    const KdTree tree(n.points, n.count, n.order);
    parallel_blocks(n.threads, n.count, 1024, [&](int64_t begin, int64_t end, int) {
        std::vector<double> distances(n.neighbours);
        for (int64_t i = begin; i < end; ++i) {
            int32_t *nearest = n.nearest + i * n.neighbours;
            std::fill_n(nearest, n.neighbours, std::numeric_limits<int32_t>::max());
            tree.find_nearest((int32_t)i, nearest, distances.data(), n.neighbours);
        }
    });
}

}  // namespace ms
