// Gradients of an image of opaque triangles with respect to where their visible edges lie.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "parallel.h"

extern "C" {

struct MsEdges {
    int32_t width, height;     // of the image, in pixels
    int32_t samples, threads;  // samples x samples in each pixel; all below is in samples where not said
    int64_t vertex_count, face_count;
    const double *screen;   // (vertex_count, 3) x and y in samples, depth
    const float *colors;    // (vertex_count, 4) straight RGBA
    const int32_t *faces;   // (face_count, 3) vertex indices
    const int32_t *across;  // (face_count, 3) the triangle across the edge from corner i to the next, or -1
    const int32_t *front;   // (rows, columns) the triangle in front at each sample, -1: none
    const float *color;     // (rows, columns, 3)
    const float *gradient;  // (height, width, 3) of a loss with respect to the colour of each pixel
    double near;            // triangles with a lesser depth are left out
    double cutoff;          // least opacity that is drawn
    double *result;         // (vertex_count, 2) gradients with respect to x and y; added to
};

}  // extern "C"

namespace ms {

// Between two neighbouring samples with different triangles in front lies an edge of one of them. If it moves
// by d along the line between them, the colour of the one sample takes the place of that of the other over a
// length of d. A line in x counts edges that are steeper than 45 degrees, one in y all others, so that every
// edge is counted once per sample.
class EdgePass {
  public:
    explicit EdgePass(const MsEdges &edges)
        : in(edges),
          rows((int64_t)edges.height * edges.samples),
          columns((int64_t)edges.width * edges.samples) {}

    void run() {
        constexpr int64_t BLOCK = 16;
        MS_ASSERT(in.width >= 1 && in.height >= 1 && in.samples >= 1);
        const int64_t blocks = (rows + BLOCK - 1) / BLOCK;
        std::vector<std::vector<Term>> terms(blocks);
        parallel_blocks(in.threads, rows, BLOCK, [&](int64_t begin, int64_t end, int) {
            std::vector<Term> &list = terms[begin / BLOCK];
            for (int64_t y = begin; y < end; ++y)
                for (int64_t x = 0; x < columns; ++x) {
                    if (x + 1 < columns) add_pair(x, y, 0, list);
                    if (y + 1 < rows) add_pair(x, y, 1, list);
                }
        });
        // In the order of the blocks, so that the sums do not depend on the threads.
        for (const auto &list : terms)
            for (const Term &term : list)
                for (int axis = 0; axis < 2; ++axis) in.result[2 * term.vertex + axis] += term.value[axis];
    }

  private:
    struct Term {
        int64_t vertex;
        double value[2];
    };

    // Where a surface ends on the way from one sample to the other.
    struct End {
        bool found = false;
        double share = 2;  // of the way
        int32_t face = -1;
        int edge = 0;      // of the face, from corner `edge` to the next one
        double depth = 0;  // at the first sample
    };

    // Triangles through which a surface is followed. Those at outlines may be narrower than a sample.
    static constexpr int LONGEST_WAY = 16;

    const double *corner(int32_t face, int i) const { return in.screen + 3 * (int64_t)vertex(face, i); }
    int32_t vertex(int32_t face, int i) const { return in.faces[3 * (int64_t)face + i % 3]; }

    static double side(const double *a, const double *b, const double *p) {
        return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
    }

    bool drawn(int32_t face) const {
        for (int i = 0; i < 3; ++i)
            if (!(corner(face, i)[2] >= in.near)) return false;
        return true;
    }

    // Follows the surface from the triangle in front at `inside` towards `outside`, from one triangle to the
    // next, to an edge behind which it does not go on.
    End end_of(int32_t face, const double *inside, const double *outside) const {
        End end;
        if (face < 0) return end;
        MS_ASSERT(face < in.face_count);
        if (!drawn(face)) return end;
        double weight[3], total = 0, inverse = 0;
        for (int i = 0; i < 3; ++i) {
            weight[i] = side(corner(face, i + 1), corner(face, i + 2), inside);  // of corner i
            total += weight[i];
            inverse += weight[i] / corner(face, i)[2];
        }
        if (total == 0 || inverse == 0) return end;
        end.depth = total / inverse;
        int entry = -1;
        for (int step = 0; step < LONGEST_WAY; ++step) {
            double share = 2;
            int edge = -1;
            const double sign = area(face) > 0 ? 1 : -1;
            for (int i = 0; i < 3; ++i) {
                if (i == entry) continue;
                const double *a = corner(face, i), *b = corner(face, i + 1);
                const double first = sign * side(a, b, inside), last = sign * side(a, b, outside);
                // Behind the first triangle, the way may begin outside; edges that it does not leave by grow.
                if (last >= 0 || last >= first || (step == 0 && first < 0)) continue;
                const double at = first / (first - last);
                if (at < share) share = at, edge = i;
            }
            if (edge < 0) return end;  // the other sample lies in this triangle
            const int32_t next = in.across[3 * (int64_t)face + edge];
            if (!continues(face, edge, next)) {
                end.found = share < 1;
                end.share = share < 0 ? 0 : share;
                end.face = face;
                end.edge = edge;
                return end;
            }
            entry = edge_of(next, vertex(face, edge), vertex(face, edge + 1));
            if (entry < 0) return end;
            face = next;
        }
        return end;
    }

    double area(int32_t face) const { return side(corner(face, 0), corner(face, 1), corner(face, 2)); }

    // Which edge of a triangle lies between two vertices.
    int edge_of(int32_t face, int32_t a, int32_t b) const {
        for (int i = 0; i < 3; ++i)
            if ((vertex(face, i) == a && vertex(face, i + 1) == b) ||
                (vertex(face, i) == b && vertex(face, i + 1) == a))
                return i;
        return -1;
    }

    // Whether the surface goes on behind an edge: then it is not what ends between the samples.
    bool continues(int32_t face, int edge, int32_t next) const {
        if (next < 0) return false;
        MS_ASSERT(next < in.face_count);
        if (!drawn(next)) return false;
        const double *a = corner(face, edge), *b = corner(face, edge + 1);
        const int entry = edge_of(next, vertex(face, edge), vertex(face, edge + 1));
        return entry >= 0 && side(a, b, corner(face, edge + 2)) * side(a, b, corner(next, entry + 2)) < 0;
    }

    void add_pair(int64_t x, int64_t y, int axis, std::vector<Term> &list) const {
        const int64_t here = y * columns + x, there = here + (axis == 0 ? 1 : columns);
        const int32_t first = in.front[here], second = in.front[there];
        if (first == second) return;
        const double p[2] = {x + 0.5, y + 0.5};
        const double q[2] = {p[0] + (axis == 0), p[1] + (axis == 1)};
        const End of_first = end_of(first, p, q), of_second = end_of(second, q, p);
        if (!of_first.found && !of_second.found) return;
        // Where both end, the nearer one covers the end of the other.
        const bool takes_first = of_first.found && (!of_second.found || of_first.depth <= of_second.depth);
        const End &end = takes_first ? of_first : of_second;
        const int32_t face = end.face;
        const double share = takes_first ? end.share : 1 - end.share;
        const int64_t a = vertex(face, end.edge), b = vertex(face, end.edge + 1);
        const double *from = in.screen + 3 * a, *to = in.screen + 3 * b;
        const double along[2] = {to[0] - from[0], to[1] - from[1]};
        const double normal[2] = {along[1], -along[0]};
        if (std::abs(normal[axis]) < std::abs(normal[1 - axis])) return;
        const double square = along[0] * along[0] + along[1] * along[1];
        if (!(square > 0)) return;
        double point[2] = {p[0], p[1]};
        point[axis] += share;
        double t = ((point[0] - from[0]) * along[0] + (point[1] - from[1]) * along[1]) / square;
        t = t < 0 ? 0 : t > 1 ? 1 : t;
        // Opacity is linear in space, not in the image. Below the cutoff, the triangle ends at its level set.
        const double nearer = (1 - t) / from[2], farther = t / to[2];
        const double opacity =
            (nearer * in.colors[4 * a + 3] + farther * in.colors[4 * b + 3]) / (nearer + farther);
        if (opacity < in.cutoff) return;
        const bool at_first = share < 0.5;
        const int64_t row = (y + (axis == 1 && !at_first)) / in.samples;
        const int64_t pixel = row * in.width + (x + (axis == 0 && !at_first)) / in.samples;
        double change = 0;
        for (int channel = 0; channel < 3; ++channel)
            change += (double)in.gradient[3 * pixel + channel] *
                      ((double)in.color[3 * here + channel] - in.color[3 * there + channel]);
        if (change == 0) return;
        const double scale = change / ((double)in.samples * in.samples * normal[axis]);
        const double moved[2] = {scale * normal[0], scale * normal[1]};
        list.push_back({a, {(1 - t) * moved[0], (1 - t) * moved[1]}});
        list.push_back({b, {t * moved[0], t * moved[1]}});
    }

    const MsEdges &in;
    const int64_t rows, columns;
};

}  // namespace ms
