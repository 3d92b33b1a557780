// Images of a textured surface: the colour of each sample by its texture coordinates, with gradients.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "parallel.h"

extern "C" {

struct MsTexture {
    int32_t rows, columns;     // of the grid of samples
    int32_t samples, threads;  // samples x samples in each pixel
    int32_t height, width;     // of the texture
    const float *uv;           // (rows, columns, 2) u to the right, v down, both 0 to 1
    const uint8_t *covered;    // (rows, columns) not 0 where a sample shows the surface
    const float *texels;       // (height, width, 3)
    float *color;              // (rows, columns, 3) out of ms_texture; samples that are not covered stay
    // For ms_texture_backward; its results are added to, and each of them may be null.
    const float *gradient;  // (rows / samples, columns / samples, 4): of a loss with respect to the colour of
                            // the samples of each pixel, and the weight that these samples have
    float *texel_sums;      // (height, width, 4): gradient, and sum of the weights, of each texel
    float *uv_gradient;     // (rows, columns, 2)
    // Where `relaxed` is given, texel_sums is cleared before, and each texel t becomes t - share * s / (w +
    // doubt), within 0 and 1, with the sums s of its colour and w of its weights. It may be `texels` itself.
    float share, doubt;
    float *relaxed;  // (height, width, 3)
};

}  // extern "C"

namespace ms {

// Texels are interpolated between their centres, and repeat beyond the border.
class TexturePass {
  public:
    explicit TexturePass(const MsTexture &texture) : in(texture) {
        MS_ASSERT(in.rows >= 0 && in.columns >= 0 && in.samples >= 1 && in.columns % in.samples == 0);
        MS_ASSERT(in.height >= 1 && in.width >= 1);
    }

    void forward() {
        each_sample([&](int64_t at, int64_t) {
            const Place p = place(at);
            for (int k = 0; k < 3; ++k)
                in.color[3 * at + k] = mix(p.fy, mix(p.fx, texel(p.y0, p.x0, k), texel(p.y0, p.x1, k)),
                                           mix(p.fx, texel(p.y1, p.x0, k), texel(p.y1, p.x1, k)));
        });
    }

    void backward() {
        if (in.uv_gradient)
            each_sample([&](int64_t at, int64_t pixel) { add_uv(at, in.gradient + 4 * pixel); });
        if (!in.texel_sums) return;
        // Every thread owns rows of the texture and goes through all samples, in their order.
        const int64_t band = (in.height + in.threads - 1) / std::max(1, in.threads);
        parallel_blocks(in.threads, in.height, std::max<int64_t>(band, 1),
                        [&](int64_t begin, int64_t end, int) {
                            float *sums = in.texel_sums + 4 * begin * in.width;
                            if (in.relaxed) std::fill(sums, sums + 4 * (end - begin) * in.width, 0.0f);
                            for (int64_t row = 0; row < in.rows; ++row)
                                each_of(row, [&](int64_t at, int64_t pixel) {
                                    add_texels(at, in.gradient + 4 * pixel, begin, end);
                                });
                            if (in.relaxed) relax(begin * in.width, end * in.width);
                        });
    }

  private:
    struct Place {
        int32_t x0, x1, y0, y1;
        float fx, fy;
    };

    // Calls body(sample, its pixel) for all covered samples, by rows.
    template <class Body>
    void each_sample(Body body) {
        parallel_blocks(in.threads, in.rows, 8, [&](int64_t begin, int64_t end, int) {
            for (int64_t row = begin; row < end; ++row) each_of(row, body);
        });
    }

    // The same for one row. Divisions would take as long as the rest: pixels are counted.
    template <class Body>
    void each_of(int64_t row, Body body) const {
        int64_t at = row * in.columns, pixel = row / in.samples * (in.columns / in.samples);
        for (int32_t column = 0; column < in.columns; column += in.samples, ++pixel)
            for (int32_t i = 0; i < in.samples; ++i, ++at)
                if (in.covered[at]) body(at, pixel);
    }

    static float mix(float share, float a, float b) { return a + share * (b - a); }

    float texel(int32_t y, int32_t x, int k) const { return in.texels[3 * ((int64_t)y * in.width + x) + k]; }

    // The two texels along one axis between whose centres a coordinate lies.
    static float between(float coordinate, int32_t side, int32_t &first, int32_t &second) {
        float whole = coordinate - std::floor(coordinate);  // not a number: neither texel is outside
        if (!(whole >= 0 && whole < 1)) whole = 0;
        const float at = whole * side - 0.5f, low = std::floor(at);
        first = low < 0 ? side - 1 : std::min((int32_t)low, side - 1);
        second = first + 1 == side ? 0 : first + 1;
        return at - low;
    }

    Place place(int64_t at) const {
        Place p;
        p.fx = between(in.uv[2 * at], in.width, p.x0, p.x1);
        p.fy = between(in.uv[2 * at + 1], in.height, p.y0, p.y1);
        return p;
    }

    void add_uv(int64_t at, const float *gradient) const {
        const Place p = place(at);
        float du = 0, dv = 0;
        for (int k = 0; k < 3; ++k) {
            const float a = texel(p.y0, p.x0, k), b = texel(p.y0, p.x1, k), c = texel(p.y1, p.x0, k),
                        d = texel(p.y1, p.x1, k);
            du += gradient[k] * mix(p.fy, b - a, d - c);
            dv += gradient[k] * mix(p.fx, c - a, d - b);
        }
        in.uv_gradient[2 * at] += du * in.width;
        in.uv_gradient[2 * at + 1] += dv * in.height;
    }

    void add_texels(int64_t at, const float *gradient, int64_t begin, int64_t end) const {
        Place p;
        p.fy = between(in.uv[2 * at + 1], in.height, p.y0, p.y1);
        if ((p.y0 < begin || p.y0 >= end) && (p.y1 < begin || p.y1 >= end)) return;
        p.fx = between(in.uv[2 * at], in.width, p.x0, p.x1);
        const int32_t y[2] = {p.y0, p.y1}, x[2] = {p.x0, p.x1};
        for (int j = 0; j < 2; ++j) {
            if (y[j] < begin || y[j] >= end) continue;
            for (int i = 0; i < 2; ++i) {
                const float share = (j ? p.fy : 1 - p.fy) * (i ? p.fx : 1 - p.fx);
                float *sums = in.texel_sums + 4 * ((int64_t)y[j] * in.width + x[i]);
                for (int k = 0; k < 4; ++k) sums[k] += share * gradient[k];
            }
        }
    }

    void relax(int64_t begin, int64_t end) const {
        for (int64_t i = begin; i < end; ++i) {
            const float *sums = in.texel_sums + 4 * i;
            const float factor = -in.share / (sums[3] + in.doubt);
            for (int k = 0; k < 3; ++k)
                in.relaxed[3 * i + k] =
                    std::max(0.0f, std::min(sums[k] * factor + in.texels[3 * i + k], 1.0f));
        }
    }

    const MsTexture in;
};

}  // namespace ms
