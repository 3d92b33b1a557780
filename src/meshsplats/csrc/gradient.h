// The way back: from the gradient of a picture to those of the vertices.
//
// With what stands behind fragment k, B_k = a_{k+1} c_{k+1} + (1 - a_{k+1}) B_{k+1} and B = background at the
// end,
//     dC/dc_k = T_k a_k,  dC/da_k = T_k (c_k - B_k),
// found from back to front, so that nothing is divided by 1 - a and a = 1 needs no exception.
//
// Values are v = (sum_k s_k v_k) / (sum_k s_k) with s = A p, p = (x, y, 1), A the inverse of the matrix V of
// the corners in homogeneous sample coordinates. As ds = -A dV s, a gradient g of v gives, summed over
// samples p at depth z = 1 / sum s,
//     dL/dv_k = A_k . sum z g p,  dL/dV = -A^T G A^T,  G_k = sum z g (v_k - v) p^T.
// So of every triangle only sums of z g and z g v times 1, x and y are needed. Which triangles a sample sees,
// and in which order, is constant.
#pragma once

#include "mesh_tile.h"

namespace ms {

// Gradients of some vertices, from one tile. A vertex comes once, or now and then a few times.
struct TileGradients {
    struct Sum {
        alignas(32) float position[4];  // and nothing
        float rgba[4];
    };
    // Of the first `count`; what is beyond has no meaning.
    Large<int32_t> vertices;
    Large<Sum> sums;
    Large<float> attributes;  // attribute_count numbers each
    size_t count = 0;

    void make_room(size_t more, int channels) {
        if (vertices.size() >= count + more) return;
        vertices.resize(std::max(count + more, 2 * vertices.size()));
        sums.resize(vertices.size());
        attributes.resize(vertices.size() * channels);
    }
};

class GradientTile {
  public:
    GradientTile(const Scene &scene, const MsOptions &options, const MsCamera &camera,
                 const MsPictureGradient &given)
        : scene_(scene),
          mesh_(scene.mesh),
          grid_(scene.grid),
          options_(options),
          camera_(camera),
          given_(given),
          extra_(given.attributes ? mesh_.attribute_count : 0),
          towards_extra_((size_t)extra_ * SAMPLES),
          fragments_(CHUNK),
          lit_(CHUNK),
          depths_(extra_ ? CHUNK : 0),
          at_(CHUNK),
          corner_extras_(3 * extra_) {
        // A filter goes on from gradients in camera space.
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                rotation_[3 * i + j] =
                    scene.filtered ? (float)(i == j) : (float)scene.projection.m[4 * i + j];
    }

    void run(int tile_x, int tile_y, const PackedLog &log, TileGradients &out) {
        area_ = TileArea(grid_, tile_x, tile_y);
        out.count = 0;
        if (!log.face_count() || !load_given()) return;
        set_up(log.faces(), log.face_count());
        for (int block = 0; block < BLOCKS; ++block) {
            log.entries(block, entries_);
            pieces_ = log.pieces(block);
            steps_ = log.steps(block);
            step_count_ = log.step_count(block);
            if (extra_)
                block_back<true>(block);
            else
                block_back<false>(block);
        }
        finish(log.face_count(), out);
    }

  private:
    static constexpr int64_t CHUNK = 1024;

    // Positions count from a place of the triangle's own, close to it and to the tile: else small triangles
    // would lose digits.
    struct Prepared {
        alignas(64) float a[4], b[4], c[4], low[4], high[4], first[4];  // of RGBA / depth; of RGBA
        float qa, qb, qc, q_min;
        float q_max, x0, y0, unused;
    };
    // Row c: sums of z g of channel c of RGBA, times 1, x and y; last column: the same of z g v.
    struct Moments {
        alignas(64) float sum[4][4];
    };
    // What only the corners of a few triangles need, side by side.
    struct Corners {
        Lanes s[3][3];      // [corner]: a, b, c of 1 / depth times its weight: the matrix A
        Lanes apart[2][4];  // RGBA of the other two minus that of the first
        int32_t vertex[3][LANES];
    };
    // An entry of the log at the samples of its block.
    struct Fragments {
        Lanes rgba[4];   // where it has a piece
        Lanes light;     // depth; then times the light that reaches it
        Lanes contrast;  // its colour, and what else is asked for, times the gradient of the sample's; then
                         // less the same of what is seen behind
    };
    // The entry they belong to, and the samples where light reaches them.
    struct Lit {
        uint32_t entry, lanes;
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
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
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

    // Makes the triangles ready.
    void set_up(const int32_t *faces, size_t n) {
        const size_t batches = (n + LANES - 1) / LANES;
        if (corners_.size() < batches) {
            triangles_.resize(batches * LANES);
            moments_.resize(batches * LANES);
            corners_.resize(batches);
        }
        planes_.resize(n * extra_);
        extra_sums_.assign(n * extra_ * 3, 0.0f);
        for (size_t i = 0; i < std::min(n, CORNERS_AHEAD); ++i) ask_for_corners(faces[i]);
        for (size_t begin = 0; begin < n; begin += LANES) set_up_batch(faces, n, begin);
    }

    static constexpr size_t FACES_AHEAD = 2 * LANES, CORNERS_AHEAD = LANES;

    __attribute__((always_inline)) void ask_for_corners(int64_t face) {
        for (int k = 0; k < 3; ++k) {
            const int64_t corner = mesh_.faces[3 * face + k];
            __builtin_prefetch(&scene_.vertices[corner]);
            __builtin_prefetch(mesh_.colors + 4 * corner);
        }
    }

    void set_up_batch(const int32_t *faces, size_t n, size_t begin) {
        const int held = (int)std::min<size_t>(LANES, n - begin);
        for (size_t i = begin; i < begin + held; ++i) {
            if (i + FACES_AHEAD < n) __builtin_prefetch(mesh_.faces + 3 * (int64_t)faces[i + FACES_AHEAD]);
            if (i + CORNERS_AHEAD < n) ask_for_corners(faces[i + CORNERS_AHEAD]);
        }
        Triangles<LANES> &t = batch_;
        Corners &corners = corners_[begin / LANES];
        fill(&faces[begin], held, corners.vertex);
        for (int i = 0; i < 3; ++i) {
            corners.s[i][0] = load_lanes(t.sa[i]);
            corners.s[i][1] = load_lanes(t.sb[i]);
            corners.s[i][2] = load_lanes(t.sc[i]);
        }
        Lanes rgba[3][4];
        for (int i = 0; i < 3; ++i) get_columns([&](int k) { return t.rgba[i][k < held ? k : 0]; }, rgba[i]);
        for (int j = 0; j < 2; ++j)
            for (int c = 0; c < 4; ++c) corners.apart[j][c] = rgba[j + 1][c] - rgba[0][c];
        Prepared *const first = &triangles_[begin];
        auto put = [&](const Lanes columns[4], float (Prepared::*row)[4]) {
            put_columns(columns[0], columns[1], columns[2], columns[3], [&](int k) { return first[k].*row; });
        };
        Lanes mixed[4];
        auto mix = [&](int j) {
            for (int c = 0; c < 4; ++c)
                mixed[c] = mul_add(corners.s[0][j], rgba[0][c],
                                   mul_add(corners.s[1][j], rgba[1][c], corners.s[2][j] * rgba[2][c]));
            return mixed;
        };
        put(mix(0), &Prepared::a);
        put(mix(1), &Prepared::b);
        put(mix(2), &Prepared::c);
        put(rgba[0], &Prepared::first);
        for (int c = 0; c < 4; ++c) mixed[c] = least(least(rgba[0][c], rgba[1][c]), rgba[2][c]);
        put(mixed, &Prepared::low);
        for (int c = 0; c < 4; ++c) mixed[c] = most(most(rgba[0][c], rgba[1][c]), rgba[2][c]);
        put(mixed, &Prepared::high);
        put_columns(load_lanes(t.qa), load_lanes(t.qb), load_lanes(t.qc), load_lanes(t.q_min),
                    [&](int k) { return &first[k].qa; });
        put_columns(load_lanes(t.q_max), load_lanes(origin_x_), load_lanes(origin_y_), lanes(0),
                    [&](int k) { return &first[k].q_max; });
        std::fill(&moments_[begin], &moments_[begin] + held, Moments{});
        for (int k = 0; k < held; ++k) {
            for (int c = 0; c < extra_; ++c) {
                Plane plane{0, 0, 0, 0, 0, 0};
                for (int i = 0; i < 3; ++i) {
                    const float v = mesh_.attributes[(int64_t)corners.vertex[i][k] * extra_ + c];
                    plane.a += t.sa[i][k] * v;
                    plane.b += t.sb[i][k] * v;
                    plane.c += t.sc[i][k] * v;
                    plane.low = i ? std::min(plane.low, v) : v;
                    plane.high = i ? std::max(plane.high, v) : v;
                    if (i == 0) plane.first = v;
                }
                planes_[(begin + k) * extra_ + c] = plane;
            }
        }
    }

    // Sets up a few triangles side by side, each with positions that count from a place of its own.
    void fill(const int32_t *faces, int held, int32_t vertex[3][LANES]) {
        Triangles<LANES> &t = batch_;
        for (int k = 0; k < held; ++k) {
            t.face[k] = faces[k];
            const int32_t *corner = mesh_.faces + 3 * (int64_t)faces[k];
            for (int i = 0; i < 3; ++i) {
                const Projected &p = scene_.vertices[corner[i]];
                t.x[i][k] = p.x - area_.x0;
                t.y[i][k] = p.y - area_.y0;
                t.w[i][k] = p.w;
                t.rgba[i][k] = mesh_.colors + 4 * (int64_t)corner[i];
                vertex[i][k] = corner[i];
            }
        }
        // Whole numbers near the middle of the corners in front: the distances of samples from them are
        // exact.
        auto middle = [&](double p[3][LANES], float *origin) {
            for (int k = 0; k < LANES; ++k) {
                double sum = 0, count = 0;
                for (int i = 0; i < 3; ++i) {
                    sum += t.w[i][k] > 0 ? p[i][k] : 0;
                    count += t.w[i][k] > 0 ? 1 : 0;
                }
                const double mean = sum / (count > 0 ? count : 1);
                origin[k] = (float)(int)(mean > 0 ? (mean < TILE ? mean : TILE) : 0);
                for (int i = 0; i < 3; ++i) p[i][k] -= origin[k];
            }
        };
        middle(t.x, origin_x_);
        middle(t.y, origin_y_);
        t.set_up_in_front();
        for (int k = 0; k < held; ++k) {
            if (t.w[0][k] > 0 && t.w[1][k] > 0 && t.w[2][k] > 0) continue;
            Vec3 v[3];
            scene_.homogeneous(mesh_.faces + 3 * (int64_t)faces[k], area_.x0 + origin_x_[k],
                               area_.y0 + origin_y_[k], v);
            t.set_up_crossing(k, v, scene_.projection.near);
        }
    }

    // Fills in what does not depend on the order; returns the depth.
    template <bool EXTRA>
    Lanes evaluate(int block, const Lanes &lane_x, const Lanes &lane_y, const TileLog::Entry entry,
                   Fragments &f) {
        const PackedLog::Numbered *piece = pieces_ + entry.first;
        Lanes q, linear[4];
        const Prepared *t = &triangles_[piece->number()];
        f4 low = load4(t->low), high = load4(t->high);
        float q_min = t->q_min, q_max = t->q_max;
        for (uint32_t i = 0;;) {
            const Lanes x = lane_x - lanes(t->x0), y = lane_y - lanes(t->y0);
            const Lanes own_q = mul_add(lanes(t->qa), x, mul_add(lanes(t->qb), y, lanes(t->qc)));
            q = i ? pick(piece[i].lanes, own_q, q) : own_q;
            for (int c = 0; c < 4; ++c) {
                const Lanes value = mul_add(lanes(t->a[c]), x, mul_add(lanes(t->b[c]), y, lanes(t->c[c])));
                linear[c] = i ? pick(piece[i].lanes, value, linear[c]) : value;
            }
            if (++i == entry.count) break;
            t = &triangles_[piece[i].number()];
            low = min4(low, load4(t->low));
            high = max4(high, load4(t->high));
            q_min = std::min(q_min, t->q_min);
            q_max = std::max(q_max, t->q_max);
        }
        const Lanes z = f.light = reciprocal(clamp(q, lanes(q_min), lanes(q_max)));
        for (int c = 0; c < 4; ++c) f.rgba[c] = clamp(linear[c] * z, lanes(low[c]), lanes(high[c]));
        const float *g = towards_[0] + block * LANES;
        f.contrast =
            mul_add(f.rgba[0], load_lanes(g),
                    mul_add(f.rgba[1], load_lanes(g + SAMPLES), f.rgba[2] * load_lanes(g + 2 * SAMPLES)));
        if (!EXTRA) return z;
        for (uint32_t i = 0; i < entry.count; ++i) {
            t = &triangles_[piece[i].number()];
            const Lanes x = lane_x - lanes(t->x0), y = lane_y - lanes(t->y0);
            for (int c = 0; c < extra_; ++c)
                f.contrast = f.contrast + only(piece[i].lanes, extra_value(piece[i].number(), c, x, y, z) *
                                                                   load_lanes(towards_extra(c, block)));
        }
        return z;
    }

    // Goes through the steps of one block. The light that reaches each fragment is found from the front, what
    // is seen behind it from the back; then entries are taken whole. Of many steps, this is done a chunk at a
    // time.
    template <bool EXTRA>
    void block_back(int block) {
        const int64_t chunks = (step_count_ + CHUNK - 1) / CHUNK;
        const Lanes enough = lanes(options_.min_transmittance);
        const Lanes lane_x = TileArea::lane_x() + lanes(TileArea::block_x(block)),
                    lane_y = TileArea::lane_y() + lanes(TileArea::block_y(block));
        auto end = [&](int64_t chunk) { return std::min(step_count_, (chunk + 1) * CHUNK); };
        // Entries get places in fragments_ chunk by chunk: what is below `used` is of an earlier one.
        places_.assign(entries_.size(), 0);
        uint32_t used = 1, count = 0;
        auto forth = [&](int64_t chunk, Lanes through) {
            used += count;
            count = 0;
            const PackedLog::Numbered *steps = steps_ + chunk * CHUNK;
            const int64_t n = end(chunk) - chunk * CHUNK;
            // Whether an entry comes for the first time is hard to predict: no branch.
            for (int64_t i = 0; i < n; ++i) {
                uint32_t &place = places_[steps[i].number()];
                lit_[count] = {steps[i].number(), 0};
                const bool fresh = place < used;
                place = fresh ? used + count : place;
                at_[i] = (uint16_t)(place - used);
                count += fresh;
            }
            for (uint32_t i = 0; i < count; ++i) {
                const Lanes depth =
                    evaluate<EXTRA>(block, lane_x, lane_y, entries_[lit_[i].entry], fragments_[i]);
                if (EXTRA) depths_[i] = depth;
            }
            for (int64_t i = 0; i < n; ++i) {
                const unsigned due = steps[i].lanes;
                Fragments &f = fragments_[at_[i]];
                f.light = pick(due, through * f.light, f.light);
                lit_[at_[i]].lanes |= due & at_least(through, enough);
                through = through - only(due, through * f.rgba[3]);
            }
            return through;
        };
        starts_.resize(chunks + 1);
        starts_[0] = lanes(1);
        for (int64_t chunk = 0; chunk < chunks; ++chunk) starts_[chunk + 1] = forth(chunk, starts_[chunk]);
        Lanes behind = load_lanes(behind_ + block * LANES);
        for (int64_t chunk = chunks - 1; chunk >= 0; --chunk) {
            if (chunk < chunks - 1) forth(chunk, starts_[chunk]);
            const PackedLog::Numbered *steps = steps_ + chunk * CHUNK;
            for (int64_t i = end(chunk) - chunk * CHUNK; i-- > 0;) {
                Fragments &f = fragments_[at_[i]];
                const Lanes contrast = f.contrast - behind;
                f.contrast = pick(steps[i].lanes, contrast, f.contrast);
                behind = behind + only(steps[i].lanes, f.rgba[3] * contrast);
            }
            for (uint32_t i = 0; i < count; ++i) add<EXTRA>(block, lane_x, lane_y, i);
        }
    }

    // Adds an entry to the moments of its triangles.
    template <bool EXTRA>
    void add(int block, const Lanes &lane_x, const Lanes &lane_y, int64_t place) {
        const Fragments &f = fragments_[place];
        const Lit lit = lit_[place];
        const TileLog::Entry entry = entries_[lit.entry];
        const Lanes light = only(lit.lanes, f.light), opaque = light * f.rgba[3];
        const float *g = towards_[0] + block * LANES;
        const Lanes all[4] = {opaque * load_lanes(g), opaque * load_lanes(g + SAMPLES),
                              opaque * load_lanes(g + 2 * SAMPLES), light * f.contrast};
        for (uint32_t i = entry.first; i < entry.first + entry.count; ++i) {
            const PackedLog::Numbered piece = pieces_[i];
            const uint32_t triangle = piece.number();
            const Prepared &t = triangles_[triangle];
            const Lanes x = lane_x - lanes(t.x0), y = lane_y - lanes(t.y0);
            Lanes sums[4], sums_y[4];
            for (int c = 0; c < 4; ++c) sums[c] = only(piece.lanes, all[c]);
            Lanes v = sums[0] * (f.rgba[0] - lanes(t.first[0]));
            for (int c = 1; c < 4; ++c) v = mul_add(sums[c], f.rgba[c] - lanes(t.first[c]), v);
            if (EXTRA) {
                for (int c = 0; c < extra_; ++c) {
                    const size_t plane = (size_t)triangle * extra_ + c;
                    const Lanes sum = only(piece.lanes, opaque * load_lanes(towards_extra(c, block)));
                    v = v +
                        sum * (extra_value(triangle, c, x, y, depths_[place]) - lanes(planes_[plane].first));
                    float *to = &extra_sums_[plane * 3];
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
            float *to = moments_[triangle].sum[0];
            store_lanes(to, load_lanes(to) + add_columns(columns));
        }
    }

    const float *towards_extra(int c, int block) const {
        return &towards_extra_[(size_t)c * SAMPLES + block * LANES];
    }
    Lanes extra_value(uint32_t place, int c, const Lanes &x, const Lanes &y, const Lanes &z) const {
        const Plane &p = planes_[(size_t)place * extra_ + c];
        return clamp(((lanes(p.a) * x + lanes(p.b) * y) + lanes(p.c)) * z, lanes(p.low), lanes(p.high));
    }

    // From sums over samples to the corners, and from corners to vertices.
    void finish(size_t count, TileGradients &out) {
        out.make_room(count + count / 2, extra_);  // of a mesh of fans; else it will grow
        for (size_t begin = 0; begin < count; begin += LANES)
            finish_batch(begin, (int)std::min<size_t>(LANES, count - begin), out);
    }

    void finish_batch(size_t begin, int held, TileGradients &out) {
        const Corners &corners = corners_[begin / LANES];
        const auto &s = corners.s;
        Lanes moments[4][4];
        for (int c = 0; c < 4; ++c)
            get_columns([&](int i) { return moments_[begin + i].sum[c]; }, moments[c]);
        // Of x, y and 1, in this order.
        Lanes of_rgba[4][3], g[3][3];
        for (int c = 0; c < 4; ++c)
            for (int j = 0; j < 3; ++j) of_rgba[c][j] = moments[c][(j + 1) % 3];
        // G, a row a corner.
        for (int j = 0; j < 3; ++j) {
            g[0][j] = lanes(0) - moments[(j + 1) % 3][3];
            for (int k = 1; k < 3; ++k) {
                g[k][j] = g[0][j];
                for (int c = 0; c < 4; ++c)
                    g[k][j] = mul_add(corners.apart[k - 1][c], of_rgba[c][j], g[k][j]);
            }
        }
        for (int c = 0; c < extra_; ++c) {
            Lanes sums[3];
            for (int j = 0; j < 3; ++j) {
                alignas(64) float column[LANES] = {};
                for (int i = 0; i < held; ++i) column[i] = extra_sums_[((begin + i) * extra_ + c) * 3 + j];
                sums[j] = load_lanes(column);
            }
            for (int k = 0; k < 3; ++k) {
                corner_extras_[k * extra_ + c] = dot(s[k], sums);
                alignas(64) float apart[LANES] = {};
                for (int i = 0; i < held; ++i)
                    apart[i] = mesh_.attributes[(int64_t)corners.vertex[k][i] * extra_ + c] -
                               planes_[(begin + i) * extra_ + c].first;
                for (int j = 0; j < 3; ++j) g[k][j] = mul_add(load_lanes(apart), sums[j], g[k][j]);
            }
        }
        alignas(64) float to_x[LANES], to_y[LANES];
        const Projection &pr = scene_.projection;
        for (int i = 0; i < LANES; ++i) {
            const Prepared &t = triangles_[begin + std::min(i, held - 1)];
            to_x[i] = (float)(pr.cx - area_.x0 - t.x0);
            to_y[i] = (float)(pr.cy - area_.y0 - t.y0);
        }
        TileGradients::Sum sums[3][LANES];
        for (int k = 0; k < 3; ++k) {
            put_columns(dot(s[k], of_rgba[0]), dot(s[k], of_rgba[1]), dot(s[k], of_rgba[2]),
                        dot(s[k], of_rgba[3]), [&](int i) { return sums[k][i].rgba; });
            Lanes d[3] = {lanes(0), lanes(0), lanes(0)};
            for (int i = 0; i < 3; ++i) {
                const Lanes h = dot(g[i], s[k]);
                for (int j = 0; j < 3; ++j) d[j] = d[j] - s[i][j] * h;
            }
            const Lanes z = mul_add(load_lanes(to_x), d[0], mul_add(load_lanes(to_y), d[1], d[2]));
            const Lanes x = d[0] * lanes((float)pr.fx), y = d[1] * lanes((float)pr.fy);
            Lanes world[3];
            for (int j = 0; j < 3; ++j)
                world[j] = mul_add(lanes(rotation_[j]), x,
                                   mul_add(lanes(rotation_[3 + j]), y, lanes(rotation_[6 + j]) * z));
            put_columns(world[0], world[1], world[2], lanes(0), [&](int i) { return sums[k][i].position; });
        }
        out.make_room(3 * LANES, extra_);
        for (int i = 0; i < held; ++i)
            for (int k = 0; k < 3; ++k) add_corner(corners.vertex[k][i], sums[k][i], k, i, out);
    }

    // Triangles of a fan come close together, so that a corner is mostly a vertex that was just met.
    void add_corner(int32_t vertex, const TileGradients::Sum &sum, int corner, int lane, TileGradients &out) {
        uint32_t &met = met_[(uint32_t)vertex % MET];
        // Whether it was is hard to predict: no branch. What is read where it was not need not be a number,
        // and counts as 0.
        const uint32_t known = met < out.count ? met : 0, next = (uint32_t)out.count;
        const bool again = (met < out.count) & (out.vertices[known] == vertex);
        const uint32_t place = met = again ? known : next;
        out.count += !again;
        out.vertices[place] = vertex;
        TileGradients::Sum &to = out.sums[place];
        store4(to.position, only4(again, load4(to.position)) + load4(sum.position));
        store4(to.rgba, only4(again, load4(to.rgba)) + load4(sum.rgba));
        for (int c = 0; c < extra_; ++c) {
            float &extra = out.attributes[(size_t)place * extra_ + c];
            extra = (again ? extra : 0) + lane_of(corner_extras_[corner * extra_ + c], lane);
        }
    }

    static Lanes dot(const Lanes a[3], const Lanes b[3]) {
        return mul_add(a[0], b[0], mul_add(a[1], b[1], a[2] * b[2]));
    }

    const Scene &scene_;
    const MsMesh &mesh_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsCamera &camera_;
    const MsPictureGradient &given_;
    const int extra_;    // channels of attributes
    float rotation_[9];  // from the space of the gradients to that of the camera
    TileArea area_;
    alignas(64) float towards_[3][SAMPLES];  // gradient of each sample's colour
    alignas(64) float behind_[SAMPLES];      // of the background, times that gradient
    std::vector<float> towards_extra_;
    Triangles<LANES> batch_;
    float origin_x_[LANES], origin_y_[LANES];
    std::vector<Prepared> triangles_;
    std::vector<Corners> corners_;  // LANES triangles each
    std::vector<Moments> moments_;
    std::vector<Plane> planes_;
    std::vector<float> extra_sums_;
    std::vector<TileLog::Entry> entries_;  // of a block
    const PackedLog::Numbered *pieces_, *steps_;
    int64_t step_count_;
    std::vector<uint32_t> places_;  // by entry
    // Of what a chunk of its steps refers to:
    std::vector<Fragments> fragments_;
    std::vector<Lit> lit_;
    std::vector<Lanes> depths_;
    std::vector<uint16_t> at_;  // by step
    std::vector<Lanes> starts_;
    std::vector<Lanes> corner_extras_;  // of a few triangles: (corner, channel)
    static constexpr uint32_t MET = 2048;
    uint32_t met_[MET] = {};  // where in the sums of a tile a vertex may be; its number is looked at there
};

// Adds the gradients of all tiles to those of the vertices, always in the order of the tiles: the result does
// not depend on the number of threads.
class VertexGradients {
  public:
    VertexGradients(const MsMesh &mesh, const MsVertexGradients &out, int attributes, int threads)
        : mesh_(mesh), out_(out), attributes_(attributes), threads_(threads) {}

    void add(const TileGradients *tiles, int count) {
        on_threads(threads_, [&](int thread) {
            const int64_t begin = mesh_.vertex_count * thread / threads_,
                          end = mesh_.vertex_count * (thread + 1) / threads_;
            for (int i = 0; i < count; ++i) {
                const TileGradients &tile = tiles[i];
                for (size_t place = 0; place < tile.count; ++place) {
                    if (place + AHEAD < tile.count) {
                        const int64_t v = tile.vertices[place + AHEAD];
                        __builtin_prefetch(out_.vertices + 3 * v, 1);
                        __builtin_prefetch(out_.colors + 4 * v, 1);
                    }
                    const int64_t v = tile.vertices[place];
                    if (v < begin || v >= end) continue;
                    const TileGradients::Sum &sum = tile.sums[place];
                    for (int j = 0; j < 3; ++j) out_.vertices[3 * v + j] += sum.position[j];
                    store4(out_.colors + 4 * v, load4(out_.colors + 4 * v) + load4(sum.rgba));
                    for (int c = 0; c < attributes_; ++c)
                        out_.attributes[v * attributes_ + c] += tile.attributes[place * attributes_ + c];
                }
            }
        });
    }

  private:
    static constexpr size_t AHEAD = 24;

    const MsMesh &mesh_;
    const MsVertexGradients &out_;
    int attributes_, threads_;
};

}  // namespace ms
