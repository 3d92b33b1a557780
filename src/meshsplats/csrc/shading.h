// Shading: vertex colours in a view, where splats have spherical harmonics. A vertex of splat s has the
// colour max(0, rgb + sum_k b_k(d) h_sk) with the unit vector d from the camera to the vertex, real spherical
// harmonics b_k of degree 1 and more, in the order of sh_color in splat_scene.h, and the coefficients h_sk.
#pragma once

#include <cmath>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "parallel.h"
#include "pooled_vector.h"

extern "C" {

struct MsShading {
    int64_t vertex_count, face_count, splat_count;
    int32_t terms;  // of a splat: 3, 8 or 15
    int32_t threads;
    const float *vertices;      // (v, 3)
    const float *colors;        // (v, 4) straight RGBA
    const int32_t *faces;       // (f, 3)
    const int32_t *face_splat;  // (f,) ascending
    const float *harmonics;     // (s, terms, 3)
    double eye[3];              // the camera's centre
    float *shaded;              // (v, 4); out of ms_shade, in of ms_shade_backward
    const float *gradient;      // (v, 4) of shaded, for ms_shade_backward; its results are added to:
    float *color_gradient, *harmonic_gradient;  // (v, 4), (s, terms, 3); the latter may be null
};

}  // extern "C"

namespace ms {

class Shading {
  public:
    explicit Shading(const MsShading &shading) : s_(shading), seen_(shading.vertex_count) {
        MS_ASSERT(s_.terms == 3 || s_.terms == 8 || s_.terms == 15);
        start_.reserve(s_.splat_count + 1);
        for (int64_t f = 0; f < s_.face_count; ++f)
            if (!f || s_.face_splat[f] != s_.face_splat[f - 1]) start_.push_back(f);
        if ((int64_t)start_.size() != s_.splat_count)
            throw std::invalid_argument("harmonics must have a row for each of the " +
                                        std::to_string(start_.size()) + " splats of the triangles, got " +
                                        std::to_string(s_.splat_count));
        start_.push_back(s_.face_count);
        std::fill(seen_.begin(), seen_.end(), (unsigned char)0);
    }

    void forward() {
        // Vertices of no triangle keep their colours.
        std::copy_n(s_.colors, 4 * s_.vertex_count, s_.shaded);
        each_batch([&](int64_t splat, const int32_t *vertex, int count, auto terms) {
            float basis[terms][BATCH];
            find_basis(vertex, count, basis);
            const float *h = s_.harmonics + splat * terms * 3;
            for (int channel = 0; channel < 3; ++channel) {
                float sum[BATCH] = {};
                for (int k = 0; k < terms; ++k)
                    for (int i = 0; i < BATCH; ++i) sum[i] += h[3 * k + channel] * basis[k][i];
                for (int i = 0; i < count; ++i) {
                    const int64_t at = 4 * (int64_t)vertex[i] + channel;
                    s_.shaded[at] = std::max(0.0f, s_.colors[at] + sum[i]);
                }
            }
        });
    }

    void backward() {
        each_batch([&](int64_t splat, const int32_t *vertex, int count, auto terms) {
            float g[3][BATCH] = {};
            bool reached = false;
            for (int i = 0; i < count; ++i) {
                const int64_t at = 4 * (int64_t)vertex[i];
                for (int channel = 0; channel < 3; ++channel) {
                    // At 0, only what leads back into the visible colours.
                    const bool passes = s_.shaded[at + channel] > 0 || s_.gradient[at + channel] < 0;
                    g[channel][i] = passes ? s_.gradient[at + channel] : 0.0f;
                    s_.color_gradient[at + channel] += g[channel][i];
                    reached |= g[channel][i] != 0;
                }
                s_.color_gradient[at + 3] += s_.gradient[at + 3];
            }
            if (!reached || !s_.harmonic_gradient) return;  // most splats of a place, in most views
            float basis[terms][BATCH];
            find_basis(vertex, count, basis);
            float *out = s_.harmonic_gradient + splat * terms * 3;
            for (int i = 0; i < count; ++i)
                for (int k = 0; k < terms; ++k)
                    for (int channel = 0; channel < 3; ++channel)
                        out[3 * k + channel] += basis[k][i] * g[channel][i];
        });
    }

  private:
    static constexpr int BATCH = 8;
    static constexpr int64_t BLOCK = 1024;  // splats

    // Calls body(splat, vertices, count, terms) for the vertices of each splat, up to BATCH at a time, each
    // once and in the order of the triangles.
    template <class Body>
    void each_batch(Body body) {
        if (s_.terms == 3) return each_batch_of(body, std::integral_constant<int, 3>());
        if (s_.terms == 8) return each_batch_of(body, std::integral_constant<int, 8>());
        each_batch_of(body, std::integral_constant<int, 15>());
    }

    template <class Body, class Terms>
    void each_batch_of(Body body, Terms terms) {
        parallel_blocks(s_.threads, s_.splat_count, BLOCK, [&](int64_t begin, int64_t end, int) {
            int32_t batch[BATCH];
            for (int64_t splat = begin; splat < end; ++splat) {
                int count = 0;
                for (int64_t c = 3 * start_[splat]; c < 3 * start_[splat + 1]; ++c) {
                    const int32_t vertex = s_.faces[c];
                    MS_ASSERT(vertex >= 0 && vertex < s_.vertex_count);
                    if (seen_[vertex]) continue;
                    seen_[vertex] = 1;
                    batch[count++] = vertex;
                    if (count == BATCH) body(splat, batch, count, terms), count = 0;
                }
                if (count) body(splat, batch, count, terms);
            }
        });
    }

    template <int Terms>
    void find_basis(const int32_t *vertex, int count, float (&b)[Terms][BATCH]) const {
        double away[3][BATCH] = {};
        for (int i = 0; i < count; ++i)
            for (int axis = 0; axis < 3; ++axis)
                away[axis][i] = (double)s_.vertices[3 * (int64_t)vertex[i] + axis] - s_.eye[axis];
        float d[3][BATCH];
        for (int i = 0; i < BATCH; ++i) {
            const double square = away[0][i] * away[0][i] + away[1][i] * away[1][i] + away[2][i] * away[2][i];
            const double scale = 1 / std::sqrt(std::max(square, 1e-300));
            for (int axis = 0; axis < 3; ++axis) d[axis][i] = (float)(away[axis][i] * scale);
        }
        for (int i = 0; i < BATCH; ++i) {
            const float x = d[0][i], y = d[1][i], z = d[2][i];
            b[0][i] = -C1 * y, b[1][i] = C1 * z, b[2][i] = -C1 * x;
            if constexpr (Terms > 3) {
                const float xx = x * x, yy = y * y, zz = z * z;
                b[3][i] = C2 * x * y, b[4][i] = -C2 * y * z, b[5][i] = C20 * (2 * zz - xx - yy);
                b[6][i] = -C2 * x * z, b[7][i] = C2 / 2 * (xx - yy);
                if constexpr (Terms > 8) {
                    b[8][i] = -C33 * y * (3 * xx - yy), b[9][i] = C32 * x * y * z;
                    b[10][i] = -C31 * y * (4 * zz - xx - yy);
                    b[11][i] = C30 * z * (2 * zz - 3 * xx - 3 * yy);
                    b[12][i] = -C31 * x * (4 * zz - xx - yy);
                    b[13][i] = C32 / 2 * z * (xx - yy), b[14][i] = -C33 * x * (xx - 3 * yy);
                }
            }
        }
    }

    // sqrt(n / (m pi)): n / m is 3/4; 15/4, 5/16; 7/16, 21/32, 105/4, 35/32.
    static constexpr float C1 = 0.48860251190291992f, C2 = 1.0925484305920792f, C20 = 0.31539156525252005f,
                           C30 = 0.37317633259011540f, C31 = 0.45704579946446572f, C32 = 2.8906114426405538f,
                           C33 = 0.59004358992664352f;

    const MsShading &s_;
    std::vector<int64_t> start_;        // first triangle of each splat, then their count
    PooledVector<unsigned char> seen_;  // vertices that a batch has held
};

}  // namespace ms
