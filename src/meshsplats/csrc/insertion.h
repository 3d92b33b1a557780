// Where one unit of a linear ordering is best placed among the others.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace ms {

// A unit that the one to be placed shares a pair with.
struct Neighbour {
    int32_t key;   // its place
    float weight;  // positive: it should lie before the one to be placed
};

// A unit that is placed after its first k neighbours, by their keys, satisfies the sum of their weights: the
// best place has the greatest prefix sum. Only those ranges of keys are sorted in which it can lie.
class Insertion {
  public:
    void clear() { all_.clear(); }
    void add(const Neighbour &neighbour) { all_.push_back(neighbour); }

    // The key of the best place, or `own` where that is as good. Beyond the first or last neighbour, keys go
    // on by twice the `spacing`.
    int32_t best(int32_t own, int32_t spacing) {
        int32_t low = std::numeric_limits<int32_t>::max(), high = std::numeric_limits<int32_t>::min();
        double now = 0, wrong = 0;
        for (const Neighbour &n : all_) {
            low = std::min(low, n.key), high = std::max(high, n.key);
            if (n.key < own) now += n.weight;
            if ((n.weight > 0) != (n.key < own)) wrong += std::fabs(n.weight);
        }
        if (wrong <= LEAST_GAIN) return own;
        divide(low, high);
        double most = 0;
        const size_t place = greatest_sum(most);
        if (most <= now + LEAST_GAIN) return own;
        int64_t before = low - 2 * (int64_t)spacing, after = high + 2 * (int64_t)spacing;
        for (size_t i = 0; i < place; ++i) before = std::max<int64_t>(before, sorted_[i].key);
        for (size_t i = place; i < sorted_.size(); ++i) after = std::min<int64_t>(after, sorted_[i].key);
        return (int32_t)((before + after) / 2);
    }

  private:
    static constexpr int RANGES = 64;
    static constexpr double LEAST_GAIN = 1e-9;

    struct Range {
        size_t begin, end;  // of `sorted_`
        double sum, gain;   // of all weights, and of the positive ones
    };

    std::vector<Neighbour> all_, sorted_;
    Range ranges_[RANGES];

    // Sorts the neighbours by ranges of keys from `low` to `high`, of one width.
    void divide(int32_t low, int32_t high) {
        int shift = 0;
        while (((int64_t)high - low) >> shift >= RANGES) ++shift;
        const auto range_of = [&](int32_t key) -> Range & { return ranges_[((int64_t)key - low) >> shift]; };
        for (Range &range : ranges_) range = {0, 0, 0, 0};
        for (const Neighbour &n : all_) {
            Range &range = range_of(n.key);
            ++range.end;
            range.sum += n.weight, range.gain += std::max(n.weight, 0.f);
        }
        size_t begin = 0;
        for (Range &range : ranges_) {
            range.begin = begin, begin += range.end;
            range.end = range.begin;
        }
        sorted_.resize(all_.size());
        for (const Neighbour &n : all_) sorted_[range_of(n.key).end++] = n;
    }

    // How many neighbours lie before the best place; `most`: the sum of their weights.
    size_t greatest_sum(double &most) {
        size_t place = 0;
        double sum = 0;
        most = 0;
        for (const Range &range : ranges_) {
            sum += range.sum;
            if (sum > most) most = sum, place = range.end;
        }
        const auto comes_first = [](const Neighbour &a, const Neighbour &b) {
            return a.key != b.key ? a.key < b.key : a.weight < b.weight;
        };
        double before = 0;
        for (const Range &range : ranges_) {
            if (before + range.gain > most) {
                std::sort(sorted_.begin() + range.begin, sorted_.begin() + range.end, comes_first);
                sum = before;
                for (size_t i = range.begin; i < range.end; ++i) {
                    sum += sorted_[i].weight;
                    if (sum > most) most = sum, place = i + 1;
                }
            }
            before += range.sum;
        }
        return place;
    }
};

}  // namespace ms
