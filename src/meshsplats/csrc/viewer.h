// A mesh as web viewers draw it on a graphics card: triangles in the order of the file, blended without a
// sort, or with an alpha test and a depth buffer.
#pragma once

#include <cstdint>
#include <vector>

#include "parallel.h"
#include "pooled_vector.h"
#include "simd.h"
#include "triangle.h"

extern "C" {

struct MsViewer {
    MsCamera camera;
    int64_t vertex_count, face_count;
    const float *vertices;    // (vertex_count, 3) world space
    const float *colors;      // (vertex_count, 4) straight RGBA, display values
    const int32_t *faces;     // (face_count, 3)
    const float *background;  // RGB
    const float *cutoffs;     // (image_count,) of the alpha test, with the depth buffer; negative: blended
    float *color;             // (image_count, height, width, 3) out
    int32_t image_count;      // images that are drawn together
    int32_t multisample;      // four samples of coverage to a pixel, one of colour; 0: one of both
    int32_t culled;           // triangles that show their backs are left out
    int32_t threads;
};

}  // extern "C"

namespace ms {

// The frame buffers have 8 bits a channel, and are rounded after each fragment. Triangles are drawn as
// three.js draws those of a double-sided, blended material: all that show their backs, then all others.
class ViewerPass {
  public:
    explicit ViewerPass(const MsViewer &viewer)
        : in(viewer), projection(viewer.camera, 1), pixel_size(viewer.image_count * PLANES) {}

    void run() {
        MS_ASSERT(in.face_count >= 0 && in.camera.width >= 1 && in.camera.height >= 1);
        vertices.resize(in.vertex_count);
        parallel_blocks(in.threads, in.vertex_count, 1 << 16, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i)
                vertices[i] = projection.project(projection.to_camera(in.vertices + 3 * i));
        });
        rows.resize(in.face_count);
        parallel_blocks(in.threads, in.face_count, 1 << 16, [&](int64_t begin, int64_t end, int) {
            for (int64_t i = begin; i < end; ++i) rows[i] = rows_of(i);
        });
        // Every band goes through all triangles: few of them, but enough to keep all threads busy.
        const int height = in.camera.height, band = std::max(8, std::min(64, height / (4 * in.threads) + 1));
        std::vector<std::vector<f4>> buffers(in.threads);
        parallel_blocks(in.threads, height, band, [&](int64_t begin, int64_t end, int thread) {
            buffers[thread].resize((size_t)band * in.camera.width * pixel_size);
            draw_band((int)begin, (int)end, buffers[thread].data());
        });
    }

  private:
    static constexpr int PLANES = 4;  // red, green, blue and 1 / depth of four samples

    // The rows of pixels that a triangle may touch; `first` > `last`: none.
    struct Rows {
        int16_t first, last;
        bool clipped, back;
    };

    struct Box {
        double low[2], high[2];

        void include(double x, double y) {
            low[0] = std::min(low[0], x), high[0] = std::max(high[0], x);
            low[1] = std::min(low[1], y), high[1] = std::max(high[1], y);
        }
    };

    const MsViewer &in;
    const Projection projection;
    const int pixel_size;  // of a pixel in a frame buffer: PLANES of each image
    PooledVector<Projected> vertices;
    PooledVector<Rows> rows;

    // Corners in camera space, x and y in pixels times depth from the origin (x0, y0).
    void corners(const int32_t *face, double x0, double y0, Vec3 out[3]) const {
        for (int k = 0; k < 3; ++k) {
            const Vec3 c = projection.to_camera(in.vertices + 3 * (int64_t)face[k]);
            out[k] = {projection.fx * c.x + (projection.cx - x0) * c.z,
                      projection.fy * c.y + (projection.cy - y0) * c.z, c.z};
        }
    }

    // The part of a triangle beyond the near plane, in pixels; false if there is none.
    bool box_of(const int32_t *face, Box &box) const {
        constexpr double inf = std::numeric_limits<double>::infinity();
        box = {{inf, inf}, {-inf, -inf}};
        int visible = 0;
        for (int k = 0; k < 3; ++k) {
            const Projected &p = vertices[face[k]];
            if (!(p.w > 0)) continue;
            box.include(p.x, p.y);
            ++visible;
        }
        if (visible == 0 || visible == 3) return visible == 3;
        Vec3 v[3];
        corners(face, 0, 0, v);
        for (int k = 0; k < 3; ++k) {
            const Vec3 &a = v[k], &b = v[(k + 1) % 3];
            if ((vertices[face[k]].w > 0) == (vertices[face[(k + 1) % 3]].w > 0)) continue;
            // As in Scene::bound_triangle.
            const double of_a = (b.z - projection.near) / (b.z - a.z);
            const double of_b = (projection.near - a.z) / (b.z - a.z);
            box.include((of_a * a.x + of_b * b.x) / projection.near,
                        (of_a * a.y + of_b * b.y) / projection.near);
        }
        return true;
    }

    // The pixels that [low, high] touches, in an image of that size; false for none.
    static bool pixels(double low, double high, int size, int &first, int &last) {
        if (!(low < size && high >= 0)) return false;
        first = low > 0 ? (int)low : 0;
        last = high < size - 1 ? (int)high : size - 1;
        return true;
    }

    Rows rows_of(int64_t i) const {
        const int32_t *face = in.faces + 3 * i;
        for (int k = 0; k < 3; ++k) MS_ASSERT(face[k] >= 0 && face[k] < in.vertex_count);
        Box box;
        int first, last, left, right;
        if (!box_of(face, box) || !pixels(box.low[1], box.high[1], in.camera.height, first, last) ||
            !pixels(box.low[0], box.high[0], in.camera.width, left, right))
            return {0, -1, false, false};
        const Projected &a = vertices[face[0]], &b = vertices[face[1]], &c = vertices[face[2]];
        const bool clipped = !(a.w > 0 && b.w > 0 && c.w > 0);
        double area;
        if (clipped) {
            Vec3 v[3];
            corners(face, 0, 0, v);
            area = determinant(v);
        } else {
            area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        }
        // Fronts turn counter-clockwise; y points down here.
        return {(int16_t)first, (int16_t)last, clipped, area > 0};
    }

    void draw_band(int begin, int end, f4 *buffer) const {
        const int64_t pixels = (int64_t)(end - begin) * in.camera.width;
        for (int64_t p = 0; p < pixels * in.image_count; ++p)
            for (int plane = 0; plane < PLANES; ++plane)
                buffer[p * PLANES + plane] = set4(plane < 3 ? 255 * in.background[plane] : 0);
        for (int pass = in.culled ? 1 : 0; pass < 2; ++pass)
            for (int64_t i = 0; i < in.face_count; ++i) {
                const Rows &r = rows[i];
                if (r.last >= begin && r.first < end && r.back == (pass == 0)) draw(i, begin, end, buffer);
            }
        for (int image = 0; image < in.image_count; ++image) {
            float *out = in.color + 3 * in.camera.width * ((int64_t)image * in.camera.height + begin);
            for (int64_t p = 0; p < pixels; ++p)
                for (int c = 0; c < 3; ++c) {
                    const f4 v = buffer[p * pixel_size + image * PLANES + c];
                    out[3 * p + c] = (v[0] + v[1] + v[2] + v[3]) / (4 * 255);
                }
        }
    }

    typedef int i4 __attribute__((vector_size(16)));

    // Whether a lane of a mask is set.
    static bool any(i4 mask) {
#if defined(__SSE2__)
        return _mm_movemask_ps((__m128)mask);
#else
        return mask[0] | mask[1] | mask[2] | mask[3];
#endif
    }

    static f4 rounded(f4 v) { return __builtin_convertvector(__builtin_convertvector(v + 0.5f, i4), f4); }

    void draw(int64_t i, int begin, int end, f4 *buffer) const {
        const int32_t *face = in.faces + 3 * i;
        Box box;
        int x0, x1, y0, y1;
        if (!box_of(face, box) || !pixels(box.low[0], box.high[0], in.camera.width, x0, x1)) return;
        y0 = std::max<int>(rows[i].first, begin), y1 = std::min<int>(rows[i].last, end - 1);
        // Four samples, rotated by the pattern of Direct3D and Vulkan, in an image whose first row is the
        // lowest.
        const f4 across = in.multisample ? f4{0.375f, 0.875f, 0.125f, 0.625f} : set4(0.5f);
        const f4 down = in.multisample ? f4{0.875f, 0.625f, 0.375f, 0.125f} : set4(0.5f);
        if (x0 == x1 && y0 == y1) {  // often a small triangle misses all samples of its pixel
            const float left = (float)(box.low[0] - x0), right = (float)(box.high[0] - x0);
            const float top = (float)(box.low[1] - y0), bottom = (float)(box.high[1] - y0);
            if (!any((across >= set4(left)) & (across <= set4(right)) & (down >= set4(top)) &
                     (down <= set4(bottom))))
                return;
        }
        TriangleSetup<1> t;
        for (int k = 0; k < 3; ++k) {
            const Projected &p = vertices[face[k]];
            t.x[k][0] = p.x - x0, t.y[k][0] = p.y - y0, t.w[k][0] = p.w;
        }
        if (rows[i].clipped) {
            Vec3 v[3];
            corners(face, x0, y0, v);
            t.set_up_clipped(0, v, projection.near);
        } else {
            t.set_up_visible();
        }
        if (t.valid[0] == 0) return;
        for (int y = y0; y <= y1; ++y)
            for (int x = x0; x <= x1; ++x) {
                const f4 px = across + (float)(x - x0), py = down + (float)(y - y0);
                i4 covered = {-1, -1, -1, -1};
                for (int k = 0; k < 3; ++k)
                    covered &= t.ea[k][0] * px + t.eb[k][0] * py + t.ec[k][0] >= set4(t.threshold[k][0]);
                const f4 depth = t.qa[0] * px + t.qb[0] * py + t.qc[0];  // its inverse
                if (rows[i].clipped) covered &= depth <= set4(t.q_max[0]);
                if (!any(covered)) continue;
                // Colours are those of the pixel's centre, even where the triangle does not reach it.
                const float cx = x - x0 + 0.5f, cy = y - y0 + 0.5f;
                const float q = std::max(t.qa[0] * cx + t.qb[0] * cy + t.qc[0], 1e-30f);
                f4 value = {0, 0, 0, 0};
                for (int k = 0; k < 3; ++k) {
                    const float weight = (t.sa[k][0] * cx + t.sb[k][0] * cy + t.sc[k][0]) / q;
                    value += weight * load4(in.colors + 4 * (int64_t)face[k]);
                }
                value = min4(max4(value, set4(0)), set4(1));
                f4 *pixel = buffer + ((int64_t)(y - begin) * in.camera.width + x) * pixel_size;
                for (int image = 0; image < in.image_count; ++image, pixel += PLANES) {
                    i4 drawn = covered;
                    float alpha = value[3];
                    if (in.cutoffs[image] >= 0) {
                        if (alpha < in.cutoffs[image]) continue;
                        alpha = 1;
                        drawn &= depth >= pixel[3];
                        pixel[3] = (f4)(((i4)pixel[3] & ~drawn) | ((i4)depth & drawn));
                    }
                    const f4 share = (f4)((i4)set4(alpha) & drawn);
                    for (int c = 0; c < 3; ++c)
                        pixel[c] = rounded(pixel[c] + share * (set4(255 * value[c]) - pixel[c]));
                }
            }
    }
};

}  // namespace ms
