// The triangles that a viewer draws of a file with an order of blending: each is listed twice, once with each
// winding, in nodes; viewers sort the nodes and leave out the copies that show their backs.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "check.h"
#include "parallel.h"
#include "pooled_vector.h"
#include "types.h"

extern "C" {

struct MsListing {
    MsCamera camera;
    int64_t vertex_count, face_count;
    const float *vertices;      // (vertex_count, 3)
    const int32_t *faces;       // (face_count, 3)
    const int32_t *face_splat;  // (face_count,), or null
    const int32_t *copies;      // (2 face_count,) j: triangle j; face_count + j: with the opposite winding
    const int64_t *starts;      // (node_count + 1,) first copy of each node
    int32_t *listed;            // (face_count, 3) out: the triangles, first to last
    int32_t *listed_splat;      // (face_count,) out, or null
    int32_t node_count;
    int32_t threads;
};

}  // extern "C"

namespace ms {

class Listing {
  public:
    explicit Listing(const MsListing &listing) : in_(listing) {}

    void run() {
        MS_ASSERT(in_.face_count >= 1 && in_.node_count >= 1 &&
                  in_.starts[in_.node_count] == 2 * in_.face_count);
        find_fronts();
        find_parts();
        parallel_blocks(in_.threads, (int64_t)parts_.size(), 1,
                        [&](int64_t i, int64_t, int) { write(parts_[i]); });
    }

  private:
    static constexpr int64_t BLOCK = 1 << 15;

    // Copies [begin, end) of one node.
    struct Part {
        int64_t begin, end, count;  // how many are drawn
        int64_t first;              // place of the first of them
    };

    const MsListing &in_;
    PooledVector<uint8_t> front_;  // by triangle: whether it shows its front
    std::vector<Part> parts_;

    int64_t triangle(int64_t place) const {
        const int64_t copy = in_.copies[place];
        return copy < in_.face_count ? copy : copy - in_.face_count;
    }
    bool drawn(int64_t place) const {
        const int64_t copy = in_.copies[place];
        return copy < in_.face_count ? front_[copy] : !front_[copy - in_.face_count];
    }
    const float *corner(int64_t face, int k) const {
        return in_.vertices + 3 * (int64_t)in_.faces[3 * face + k];
    }

    // Of a triangle, exactly one copy is drawn, also of one that is seen edge on.
    void find_fronts() {
        const double *m = in_.camera.world_to_camera;
        double eye[3];
        for (int k = 0; k < 3; ++k) eye[k] = -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]);
        front_.resize(in_.face_count);
        parallel_blocks(in_.threads, in_.face_count, BLOCK, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i) {
                double e[3][3];
                for (int k = 0; k < 3; ++k)
                    for (int c = 0; c < 3; ++c) e[k][c] = corner(i, k)[c] - eye[c];
                const double volume = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) +
                                      e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
                                      e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]);
                front_[i] = volume < 0;
            }
        });
    }

    // Depth of the middle of the bounds of each node, as viewers sort objects.
    std::vector<double> node_depths() const {
        std::vector<double> depths(in_.node_count);
        parallel_blocks(in_.threads, in_.node_count, 1, [&](int64_t node, int64_t, int) {
            constexpr float inf = std::numeric_limits<float>::infinity();
            float low[3] = {inf, inf, inf}, high[3] = {-inf, -inf, -inf};
            for (int64_t place = in_.starts[node]; place < in_.starts[node + 1]; ++place) {
                if (in_.copies[place] >= in_.face_count) continue;
                for (int k = 0; k < 3; ++k)
                    for (int c = 0; c < 3; ++c) {
                        const float value = corner(in_.copies[place], k)[c];
                        low[c] = std::min(low[c], value), high[c] = std::max(high[c], value);
                    }
            }
            double depth = 0;
            for (int c = 0; c < 3; ++c)
                depth += in_.camera.world_to_camera[8 + c] * (((double)low[c] + high[c]) / 2);
            depths[node] = depth;
        });
        return depths;
    }

    // All copies in parts, those of the farthest node first, with the places of what is drawn of them.
    void find_parts() {
        const std::vector<double> depths = node_depths();
        std::vector<int32_t> nodes(in_.node_count);
        for (int32_t node = 0; node < in_.node_count; ++node) nodes[node] = node;
        std::stable_sort(nodes.begin(), nodes.end(),
                         [&](int32_t a, int32_t b) { return depths[a] > depths[b]; });
        for (int32_t node : nodes)
            for (int64_t begin = in_.starts[node]; begin < in_.starts[node + 1]; begin += BLOCK)
                parts_.push_back({begin, std::min(begin + BLOCK, in_.starts[node + 1]), 0, 0});
        parallel_blocks(in_.threads, (int64_t)parts_.size(), 1, [&](int64_t i, int64_t, int) {
            Part &part = parts_[i];
            for (int64_t place = part.begin; place < part.end; ++place) part.count += drawn(place);
        });
        int64_t sum = 0;
        for (Part &part : parts_) part.first = sum, sum += part.count;
        MS_ASSERT(sum == in_.face_count);
    }

    void write(const Part &part) const {
        int64_t to = part.first;
        for (int64_t place = part.begin; place < part.end; ++place) {
            if (!drawn(place)) continue;
            const int64_t face = triangle(place);
            for (int k = 0; k < 3; ++k) in_.listed[3 * to + k] = in_.faces[3 * face + k];
            if (in_.listed_splat) in_.listed_splat[to] = in_.face_splat[face];
            ++to;
        }
    }
};

}  // namespace ms
