// The way back: from the gradient of a picture to those of the vertices.
//
// With what stands behind fragment k, B_k = a_{k+1} c_{k+1} + (1 - a_{k+1}) B_{k+1} and B = background at the end,
//     dC/dc_k = T_k a_k,  dC/da_k = T_k (c_k - B_k),
// found from back to front, so that nothing is divided by 1 - a and a = 1 needs no exception.
//
// Values are v = (sum_k s_k v_k) / (sum_k s_k) with s = A p, p = (x, y, 1), A the inverse of the matrix V of the corners in
// homogeneous sample coordinates. As ds = -A dV s, a gradient g of v gives, summed over samples p at depth z = 1 / sum s,
//     dL/dv_k = A_k . sum z g p,  dL/dV = -A^T G A^T,  G_k = sum z g (v_k - v) p^T.
// So of every triangle only sums of z g and z g v times 1, x and y are needed. Which triangles a sample sees, and in which
// order, is constant.
#pragma once

#include "mesh_tile.h"

namespace ms {

// Gradients with respect to the corners of one triangle, from one tile.
struct CornerGradients {
    int32_t vertex[3];
    float position[3][3];
    float rgba[3][4];
};

class GradientTile {
  public:
    GradientTile(const Scene &scene, const MsOptions &options, const MsCamera &camera, const MsPictureGradient &given)
        : scene_(scene), mesh_(scene.mesh), grid_(scene.grid), options_(options), camera_(camera), given_(given),
          extra_(given.attributes ? mesh_.attribute_count : 0), towards_extra_((size_t)extra_ * SAMPLES) {}

    // Adds a tile's gradients to the lists; of attributes, (3, attribute_count) numbers a triangle.
    void run(int tile_x, int tile_y, const TileLog &log, std::vector<CornerGradients> &out, std::vector<float> &out_attributes) {
        area_ = TileArea(grid_, tile_x, tile_y);
        if (log.steps.empty() || !load_given()) return;
        set_up(log);
        const int64_t n = fragment_count_, chunks = (n + CHUNK - 1) / CHUNK;
        // The light that reaches each fragment is found from the front and kept for a chunk of them.
        if (found_.size() < (size_t)std::min<int64_t>(n, CHUNK)) found_.resize((size_t)std::min<int64_t>(n, CHUNK));
        starts_.resize((size_t)chunks * SAMPLES);
        for (int i = 0; i < SAMPLES; ++i) through_[i] = 1;
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            std::copy(through_, through_ + SAMPLES, starts_.begin() + chunk * SAMPLES);
            forth(chunk * CHUNK, std::min(n, (chunk + 1) * CHUNK));
        }
        for (int64_t chunk = chunks - 1; chunk >= 0; --chunk) {
            if (chunk < chunks - 1) {
                std::copy(starts_.begin() + chunk * SAMPLES, starts_.begin() + (chunk + 1) * SAMPLES, through_);
                forth(chunk * CHUNK, std::min(n, (chunk + 1) * CHUNK));
            }
            if (extra_)
                back<true>(chunk * CHUNK, std::min(n, (chunk + 1) * CHUNK));
            else
                back<false>(chunk * CHUNK, std::min(n, (chunk + 1) * CHUNK));
        }
        out.resize(triangles_.size());
        out_attributes.reserve(triangles_.size() * extra_ * 3);
        for (size_t i = 0; i < triangles_.size(); ++i) finish(i, out[i], out_attributes);
    }

  private:
    static constexpr int64_t CHUNK = 1 << 14;
    // Row c: sums of z g of channel c of RGBA, times 1, x and y; last column: the same of z g v.
    struct Moments {
        alignas(64) float sum[4][4];
    };
    // The samples of a block that take a fragment of one triangle.
    struct Fragment {
        int32_t place;
        uint16_t lanes, block;
    };

    // Positions count from a place of the triangle's own, close to it and to the tile: else small triangles would lose digits.
    struct Prepared {
        alignas(16) float a[4], b[4], c[4];
        alignas(16) float low[4], high[4], first[4];
        float qa, qb, qc, q_min, q_max;
        float x0, y0;
    };
    // What only its corners need.
    struct Corners {
        alignas(16) float apart[2][4];  // RGBA of the other two minus that of the first
        alignas(16) float s[3][4];      // a, b, c of 1 / depth times the weight of each: the matrix A
        int32_t vertex[3];
    };
    struct Found {
        Lanes z, light;  // depth; the light that reaches the fragment, times depth, 0 where there is none
    };
    struct Plane {
        float a, b, c, low, high, first;
    };

    bool load_given() {
        const int s = grid_.samples;
        const float share = 1.0f / (s * s);
        bool any = false;
        for (int c = 0; c < 3; ++c) std::fill(towards_[c], towards_[c] + SAMPLES, 0.0f);
        std::fill(behind_, behind_ + SAMPLES, 0.0f);
        std::fill(towards_extra_.begin(), towards_extra_.end(), 0.0f);
        for (int y = 0; y < area_.rows; ++y) {
            for (int x = 0; x < area_.columns; ++x) {
                const int sample = TileArea::number(x, y);
                const int64_t pixel = (int64_t)((area_.y0 + y) / s) * camera_.width + (area_.x0 + x) / s;
                const float *background = options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                float end = given_.alpha ? -given_.alpha[pixel] * share : 0;
                any |= end != 0;
                for (int c = 0; c < 3; ++c) {
                    const float g = given_.color[3 * pixel + c] * share;
                    towards_[c][sample] = g;
                    end += g * background[c];
                    any |= g != 0;
                }
                for (int c = 0; c < extra_; ++c) {
                    const float g = given_.attributes[pixel * extra_ + c] * share;
                    towards_extra_[(size_t)c * SAMPLES + sample] = g;
                    any |= g != 0;
                }
                behind_[sample] = end;
            }
        }
        return any;
    }

    // Makes the triangles ready that the log names.
    void set_up(const TileLog &log) {
        place_.assign(log.faces.size(), -1);
        size_t n = 0;
        for (const TileLog::Step &step : log.steps) {
            if (fragments_.size() < n + step.count) fragments_.resize(std::max(n + step.count, 2 * n));
            for (uint32_t i = step.first; i < step.first + step.count; ++i) {
                const TileLog::Piece &piece = log.pieces[i];
                const uint32_t lanes = piece.lanes & step.lanes;
                fragments_[n] = {(int32_t)piece.triangle, (uint16_t)lanes, step.block};
                place_[piece.triangle] &= lanes ? 0 : -1;
                n += lanes != 0;
            }
        }
        fragment_count_ = (int64_t)n;
        triangles_.clear();
        corners_.clear();
        planes_.clear();
        int held = 0;
        int32_t numbers[Triangles::N];
        for (size_t i = 0; i < place_.size(); ++i) {
            if (i + 24 < place_.size()) __builtin_prefetch(mesh_.faces + 3 * (int64_t)log.faces[i + 24]);
            if (i + 12 < place_.size()) {
                for (int k = 0; k < 3; ++k) {
                    const int64_t corner = mesh_.faces[3 * (int64_t)log.faces[i + 12] + k];
                    __builtin_prefetch(&scene_.vertices[corner]);
                    __builtin_prefetch(mesh_.colors + 4 * corner);
                }
            }
            if (place_[i] < 0) continue;
            numbers[held++] = (int32_t)i;
            if (held == Triangles::N) {
                set_up_held(log, numbers, held);
                held = 0;
            }
        }
        if (held) set_up_held(log, numbers, held);
        for (int64_t i = 0; i < fragment_count_; ++i) fragments_[i].place = place_[fragments_[i].place];
        moments_.assign(triangles_.size(), Moments{});
        extra_sums_.assign(triangles_.size() * extra_ * 3, 0.0f);
    }

    void set_up_held(const TileLog &log, const int32_t *numbers, int held) {
        fill(held, [&](int k) { return log.faces[numbers[k]]; });
        for (int k = 0; k < held; ++k) {
            place_[numbers[k]] = (int32_t)triangles_.size();
            triangles_.emplace_back();
            corners_.emplace_back();
            Prepared &p = triangles_.back();
            Corners &corners = corners_.back();
            const Triangles &t = batch_;
            const f4 c[3] = {load4(t.rgba[0][k]), load4(t.rgba[1][k]), load4(t.rgba[2][k])};
            auto mix = [&](float *out, const float s[3][Triangles::N]) {
                store4(out, set4(s[0][k]) * c[0] + set4(s[1][k]) * c[1] + set4(s[2][k]) * c[2]);
            };
            mix(p.a, t.sa);
            mix(p.b, t.sb);
            mix(p.c, t.sc);
            store4(p.low, min4(min4(c[0], c[1]), c[2]));
            store4(p.high, max4(max4(c[0], c[1]), c[2]));
            store4(p.first, c[0]);
            store4(corners.apart[0], c[1] - c[0]);
            store4(corners.apart[1], c[2] - c[0]);
            p.qa = t.qa[k];
            p.qb = t.qb[k];
            p.qc = t.qc[k];
            p.q_min = t.q_min[k];
            p.q_max = t.q_max[k];
            p.x0 = (float)origin_x_[k];
            p.y0 = (float)origin_y_[k];
            const int32_t *vertex = mesh_.faces + 3 * (int64_t)t.face[k];
            for (int i = 0; i < 3; ++i) {
                store4(corners.s[i], f4{t.sa[i][k], t.sb[i][k], t.sc[i][k], 0});
                corners.vertex[i] = vertex[i];
            }
            for (int c = 0; c < extra_; ++c) {
                Plane plane{0, 0, 0, 0, 0, 0};
                for (int i = 0; i < 3; ++i) {
                    const float v = mesh_.attributes[(int64_t)vertex[i] * extra_ + c];
                    plane.a += t.sa[i][k] * v;
                    plane.b += t.sb[i][k] * v;
                    plane.c += t.sc[i][k] * v;
                    plane.low = i ? std::min(plane.low, v) : v;
                    plane.high = i ? std::max(plane.high, v) : v;
                    if (i == 0) plane.first = v;
                }
                planes_.push_back(plane);
            }
        }
    }

    // Sets up the first few of the triangles side by side, each with positions that count from a place of its own.
    template <class Face>
    void fill(int held, Face face_of) {
        Triangles &t = batch_;
        unsigned crossing = 0;
        for (int k = 0; k < held; ++k) {
            t.face[k] = face_of(k);
            const int32_t *corner = mesh_.faces + 3 * (int64_t)t.face[k];
            double sum_x = 0, sum_y = 0;
            int in_front = 0;
            for (int i = 0; i < 3; ++i) {
                const Projected &p = scene_.vertices[corner[i]];
                if (p.w > 0) {
                    sum_x += p.x - area_.x0;
                    sum_y += p.y - area_.y0;
                    ++in_front;
                }
                t.rgba[i][k] = mesh_.colors + 4 * (int64_t)corner[i];
            }
            // Whole numbers: the distances of samples from it are exact.
            const double share = in_front == 3 ? 1.0 / 3 : 1.0 / std::max(in_front, 1);
            origin_x_[k] = std::floor(std::min(std::max(sum_x * share, 0.0), (double)TILE));
            origin_y_[k] = std::floor(std::min(std::max(sum_y * share, 0.0), (double)TILE));
            for (int i = 0; i < 3; ++i) {
                const Projected &p = scene_.vertices[corner[i]];
                t.x[i][k] = p.x - (area_.x0 + origin_x_[k]);
                t.y[i][k] = p.y - (area_.y0 + origin_y_[k]);
                t.w[i][k] = p.w;
            }
            if (in_front < 3) crossing |= 1u << k;
        }
        t.set_up_in_front();
        for (; crossing; crossing &= crossing - 1) {
            const int k = __builtin_ctz(crossing);
            Vec3 v[3];
            scene_.homogeneous(mesh_.faces + 3 * (int64_t)t.face[k], area_.x0 + origin_x_[k], area_.y0 + origin_y_[k], v);
            t.set_up_crossing(k, v, scene_.projection.near);
        }
    }

    // A triangle at the samples of a block: where they are, the depth, a value.
    static void positions(const Prepared &t, int block, Lanes &x, Lanes &y) {
        x = TileArea::lane_x() + lanes(TileArea::block_x(block) - t.x0);
        y = TileArea::lane_y() + lanes(TileArea::block_y(block) - t.y0);
    }
    static Lanes depth(const Prepared &t, const Lanes &x, const Lanes &y) {
        const Lanes q = mul_add(lanes(t.qa), x, mul_add(lanes(t.qb), y, lanes(t.qc)));
        return lanes(1) / clamp(q, lanes(t.q_min), lanes(t.q_max));
    }
    static Lanes value(const Prepared &t, int channel, const Lanes &x, const Lanes &y, const Lanes &z) {
        const Lanes linear = mul_add(lanes(t.a[channel]), x, mul_add(lanes(t.b[channel]), y, lanes(t.c[channel])));
        return clamp(linear * z, lanes(t.low[channel]), lanes(t.high[channel]));
    }

    // Notes the light that reaches each fragment, as the picture was drawn.
    void forth(int64_t begin, int64_t end) {
        const Lanes enough = lanes(options_.min_transmittance);
        for (int64_t i = begin; i < end; ++i) {
            const Fragment &f = fragments_[i];
            const Prepared &t = triangles_[f.place];
            Lanes x, y;
            positions(t, f.block, x, y);
            const Lanes z = depth(t, x, y), alpha = only(f.lanes, value(t, 3, x, y, z));
            float *at = through_ + f.block * LANES;
            const Lanes before = load_lanes(at);
            store_lanes(at, before - before * alpha);
            found_[i - begin] = {z, only(f.lanes & at_least(before, enough), before * z)};
        }
    }

    template <bool EXTRA>
    void back(int64_t begin, int64_t end) {
        for (int64_t i = end - 1; i >= begin; --i) {
            const Fragment &f = fragments_[i];
            const Prepared &t = triangles_[f.place];
            Lanes x, y;
            positions(t, f.block, x, y);
            const Lanes z = found_[i - begin].z, light = found_[i - begin].light;
            Lanes rgba[4];
            for (int c = 0; c < 4; ++c) rgba[c] = value(t, c, x, y, z);
            Lanes g[3];
            for (int c = 0; c < 3; ++c) g[c] = load_lanes(towards_[c] + f.block * LANES);
            Lanes own = mul_add(rgba[0], g[0], mul_add(rgba[1], g[1], rgba[2] * g[2]));
            if (EXTRA)
                for (int c = 0; c < extra_; ++c) own = own + extra_value(f.place, c, x, y, z) * load_lanes(towards_extra(c, f.block));
            float *at = behind_ + f.block * LANES;
            const Lanes behind = load_lanes(at), contrast = own - behind, alpha = only(f.lanes, rgba[3]);
            store_lanes(at, mul_add(behind, lanes(1) - alpha, alpha * own));

            const Lanes opaque = light * rgba[3];
            Lanes sums[4], sums_y[4];
            for (int c = 0; c < 3; ++c) sums[c] = opaque * g[c];
            sums[3] = light * contrast;
            Lanes v = sums[0] * (rgba[0] - lanes(t.first[0]));
            for (int c = 1; c < 4; ++c) v = mul_add(sums[c], rgba[c] - lanes(t.first[c]), v);
            if (EXTRA) {
                for (int c = 0; c < extra_; ++c) {
                    const Lanes sum = opaque * load_lanes(towards_extra(c, f.block));
                    v = v + sum * (extra_value(f.place, c, x, y, z) - lanes(planes_[(size_t)f.place * extra_ + c].first));
                    float *to = &extra_sums_[((size_t)f.place * extra_ + c) * 3];
                    to[0] += ::ms::sum(sum * x);
                    to[1] += ::ms::sum(sum * y);
                    to[2] += ::ms::sum(sum);
                }
            }
            for (int c = 0; c < 4; ++c) sums_y[c] = sums[c] * y;
            const Lanes sums_v[4] = {v, v * x, v * y, lanes(0)};
            // x is the same in every row.
            Lanes columns[4] = {add_rows(sums), lanes(0), add_rows(sums_y), add_rows(sums_v)};
            columns[1] = columns[0] * x;
            float *to = moments_[f.place].sum[0];
            store_lanes(to, load_lanes(to) + add_columns(columns));
        }
    }

    const float *towards_extra(int c, int block) const { return &towards_extra_[(size_t)c * SAMPLES + block * LANES]; }
    Lanes extra_value(int32_t place, int c, const Lanes &x, const Lanes &y, const Lanes &z) const {
        const Plane &p = planes_[(size_t)place * extra_ + c];
        return clamp(((lanes(p.a) * x + lanes(p.b) * y) + lanes(p.c)) * z, lanes(p.low), lanes(p.high));
    }

    // From sums over samples to the corners.
    void finish(size_t place, CornerGradients &out, std::vector<float> &out_attributes) const {
        const Prepared &t = triangles_[place];
        const Corners &p = corners_[place];
        const auto &m = moments_[place].sum;
        // Vectors have an element for x, y and 1, in this order, or for r, g, b and a.
        const f4 s[3] = {load4(p.s[0]), load4(p.s[1]), load4(p.s[2])};
        f4 sums[3];
        for (int j = 0; j < 3; ++j) {
            const int column = (j + 1) % 3;
            sums[j] = f4{m[0][column], m[1][column], m[2][column], m[3][column]};
        }
        for (int k = 0; k < 3; ++k)
            store4(out.rgba[k], set4(s[k][0]) * sums[0] + (set4(s[k][1]) * sums[1] + set4(s[k][2]) * sums[2]));
        // G, a row a corner.
        f4 g[3];
        g[0] = g[1] = g[2] = -f4{m[1][3], m[2][3], m[0][3], 0};
        for (int c = 0; c < 4; ++c) {
            const f4 by_channel = {m[c][1], m[c][2], m[c][0], 0};
            for (int k = 1; k < 3; ++k) g[k] = g[k] + set4(p.apart[k - 1][c]) * by_channel;
        }
        for (int k = 0; k < 3; ++k) {
            for (int c = 0; c < extra_; ++c) {
                const float *e = &extra_sums_[(place * extra_ + c) * 3];
                const f4 sums_e = {e[0], e[1], e[2], 0}, products = s[k] * sums_e;
                out_attributes.push_back((products[0] + products[1]) + products[2]);
                const float d = mesh_.attributes[(int64_t)p.vertex[k] * extra_ + c] - planes_[place * extra_ + c].first;
                g[k] = g[k] + set4(d) * sums_e;
            }
        }
        const Projection &pr = scene_.projection;
        const f4 rows[3] = {{(float)pr.m[0], (float)pr.m[1], (float)pr.m[2], 0},
                            {(float)pr.m[4], (float)pr.m[5], (float)pr.m[6], 0},
                            {(float)pr.m[8], (float)pr.m[9], (float)pr.m[10], 0}};
        const float to_x = (float)(pr.cx - area_.x0 - t.x0), to_y = (float)(pr.cy - area_.y0 - t.y0);
        for (int k = 0; k < 3; ++k) {
            out.vertex[k] = p.vertex[k];
            f4 d = set4(0);
            for (int i = 0; i < 3; ++i) {
                const f4 h = g[i] * s[k];
                d = d - s[i] * set4((h[0] + h[1]) + h[2]);
            }
            const float z = d[2] + to_x * d[0] + to_y * d[1];
            const f4 move = rows[0] * set4((float)pr.fx * d[0]) + (rows[1] * set4((float)pr.fy * d[1]) + rows[2] * set4(z));
            for (int j = 0; j < 3; ++j) out.position[k][j] = move[j];
        }
    }

    const Scene &scene_;
    const MsMesh &mesh_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsCamera &camera_;
    const MsPictureGradient &given_;
    const int extra_;  // channels of attributes
    TileArea area_;
    alignas(64) float towards_[3][SAMPLES];  // gradient of each sample's colour
    alignas(64) float through_[SAMPLES];
    alignas(64) float behind_[SAMPLES];      // what is seen behind, times that gradient
    std::vector<float> towards_extra_;
    Triangles batch_;
    double origin_x_[Triangles::N], origin_y_[Triangles::N];
    std::vector<int32_t> place_;  // of the log's triangles
    std::vector<Fragment> fragments_;
    int64_t fragment_count_ = 0;
    std::vector<Prepared> triangles_;
    std::vector<Corners> corners_;
    std::vector<Moments> moments_;
    std::vector<Plane> planes_;
    std::vector<float> extra_sums_;
    std::vector<Found> found_;
    std::vector<float> starts_;
};

// Adds the gradients of all tiles to those of the vertices, always in the order of the tiles: the result does not depend on
// the number of threads.
class VertexGradients {
  public:
    VertexGradients(const MsMesh &mesh, const MsVertexGradients &out, int attributes, int threads)
        : mesh_(mesh), out_(out), attributes_(attributes), threads_(threads) {}

    void add(const std::vector<CornerGradients> *tiles, const std::vector<float> *attributes, int count) {
        on_threads(threads_, [&](int thread) {
            const int64_t begin = mesh_.vertex_count * thread / threads_, end = mesh_.vertex_count * (thread + 1) / threads_;
            for (int i = 0; i < count; ++i) {
                const float *extra = attributes[i].data();
                const size_t n = tiles[i].size();
                for (size_t number = 0; number < n; ++number) {
                    const CornerGradients &g = tiles[i][number];
                    if (number + 8 < n) {
                        for (int64_t v : tiles[i][number + 8].vertex) {
                            __builtin_prefetch(out_.vertices + 3 * v, 1);
                            __builtin_prefetch(out_.colors + 4 * v, 1);
                        }
                    }
                    for (int k = 0; k < 3; ++k, extra += attributes_) {
                        const int64_t v = g.vertex[k];
                        if (v < begin || v >= end) continue;
                        for (int j = 0; j < 3; ++j) out_.vertices[3 * v + j] += g.position[k][j];
                        store4(out_.colors + 4 * v, load4(out_.colors + 4 * v) + load4(g.rgba[k]));
                        for (int c = 0; c < attributes_; ++c) out_.attributes[v * attributes_ + c] += extra[c];
                    }
                }
            }
        });
    }

  private:
    const MsMesh &mesh_;
    const MsVertexGradients &out_;
    int attributes_, threads_;
};

}  // namespace ms
