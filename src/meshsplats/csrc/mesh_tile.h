// Draws the triangles of one tile: exact order at every sample, front to back.
//
// Groups come nearest first. Their fragments wait in a list per sample; a flush sorts each list and blends what is
// nearer than anything still to come, so the result does not depend on the order in which triangles arrive.
#pragma once

#include <memory>

#include "scene.h"

namespace ms {

// What a picture needs besides colour.
struct Extras {
    bool any = false;
    int channels = 0;  // depth, normals, attributes, in this order
    int depth = -1, normals = -1, attributes = -1;

    Extras(const MsPicture &picture, const MsMesh &mesh) {
        if (picture.depth) depth = channels, channels += 1;
        if (picture.normals) normals = channels, channels += 3;
        if (picture.attributes) attributes = channels, channels += mesh.attribute_count;
        any = channels > 0;
    }
};

// Where in its triangle a fragment lies; kept only where extras are asked for.
struct Place {
    float b[3];
    float z;
};

class MeshTile {
  public:
    MeshTile(const Scene &scene, const MsOptions &options, const MsPicture &picture, const MsCamera &camera)
        : scene_(scene), grid_(scene.grid), options_(options), picture_(picture), camera_(camera),
          extras_(picture, scene.mesh), arena_(new Arena), sums_((size_t)SAMPLES * extras_.channels) {
        for (int i = 0; i < TILE; ++i) center_[i] = i + 0.5f;
    }

    int64_t fragments() const { return fragments_; }

    void draw(int tile_x, int tile_y, const uint32_t *list, int64_t length) {
        begin(tile_x, tile_y);
        for (int64_t i = 0; i < length; ++i) {
            const Item &item = scene_.items[list[i]];
            if (i + 8 < length) prefetch_faces(scene_.items[list[i + 8]].number);
            if (i + 4 < length) prefetch_corners(scene_.items[list[i + 4]].number);
            if (pending_ >= limit_) {
                if (flush(item.key)) break;
            }
            if (extras_.any)
                add_group<true>(item.number);
            else
                add_group<false>(item.number);
        }
        flush(-1);
        finish();
    }

  private:
    static constexpr int SAMPLES = TILE * TILE;
    static constexpr int ROOM = 32;       // fragments a sample in the arena; more go to a list on the heap
    static constexpr int PER_SAMPLE = 8;  // mean number of waiting fragments at which they are flushed

    // The waiting fragments of all samples.
    struct Arena {
        alignas(64) float key[SAMPLES][ROOM];
        alignas(64) int32_t face[SAMPLES][ROOM];
        alignas(64) float rgba[SAMPLES][ROOM][4];
        Place place[SAMPLES][ROOM];
    };
    struct Fragment {
        f4 rgba;
        float key;
        int32_t face;
        Place place;
    };
    // The samples that one triangle covers, side by side.
    struct Found {
        alignas(64) float x[SAMPLES + W], y[SAMPLES + W], q[SAMPLES + W], z[SAMPLES + W], e[3][SAMPLES + W];
    };
    // The fragments of one sample in one piece.
    struct Long {
        std::vector<float> key, rgba;
        std::vector<int32_t> face;
        std::vector<Place> place;
    };

    const Scene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsPicture &picture_;
    const MsCamera &camera_;
    Extras extras_;
    std::unique_ptr<Arena> arena_;
    std::vector<Fragment> overflow_[SAMPLES];
    Long long_;
    Found found_;

    alignas(64) float center_[TILE];
    int32_t count_[SAMPLES];
    int32_t layers_[SAMPLES];
    f4 color_[SAMPLES];
    float through_[SAMPLES];
    uint32_t open_[TILE];  // per row, the samples that still take light
    std::vector<float> sums_;
    std::vector<int32_t> order_, rank_;
    std::vector<Fragment> kept_;

    int x0_, y0_, columns_, rows_;  // the tile in samples
    int64_t pending_, limit_, fragments_ = 0;

    void begin(int tile_x, int tile_y) {
        x0_ = tile_x * grid_.side;
        y0_ = tile_y * grid_.side;
        columns_ = std::min(grid_.side, grid_.width - x0_);
        rows_ = std::min(grid_.side, grid_.height - y0_);
        for (int i = 0; i < SAMPLES; ++i) {
            overflow_[i].clear();
            count_[i] = 0;
            layers_[i] = 0;
            color_[i] = f4{};
            through_[i] = 1;
        }
        for (int row = 0; row < TILE; ++row) open_[row] = row < rows_ ? (1u << columns_) - 1 : 0;
        std::fill(sums_.begin(), sums_.end(), 0.0f);
        pending_ = 0;
        limit_ = (int64_t)PER_SAMPLE * rows_ * columns_;
    }

    // Groups come in the order of depth, which is no order in memory: their data is asked for some groups ahead.
    void prefetch_faces(int32_t group) const {
        const int32_t *face = scene_.mesh.faces + 3 * (int64_t)scene_.group_start[group];
        __builtin_prefetch(face);
        __builtin_prefetch(face + 16);
    }
    void prefetch_corners(int32_t group) const {
        const int32_t *face = scene_.mesh.faces + 3 * (int64_t)scene_.group_start[group];
        const int32_t *end = scene_.mesh.faces + 3 * (int64_t)scene_.group_start[group + 1];
        for (; face < end; face += 3) {
            __builtin_prefetch(&scene_.vertices[face[1]]);
            __builtin_prefetch(scene_.mesh.colors + 4 * (int64_t)face[1]);
        }
    }

    template <bool PLACES>
    void add_group(int32_t group) {
        const MsMesh &mesh = scene_.mesh;
        for (int32_t f = scene_.group_start[group]; f < scene_.group_start[group + 1]; ++f) {
            const int32_t *corner = mesh.faces + 3 * (int64_t)f;
            Projected p[3];
            bool crossing = false;
            double lo_x = 1e300, hi_x = -1e300, lo_y = 1e300, hi_y = -1e300;
            for (int k = 0; k < 3; ++k) {
                p[k] = scene_.vertices[corner[k]];
                p[k].x -= x0_;
                p[k].y -= y0_;
                crossing |= !(p[k].w > 0);
                lo_x = std::min(lo_x, p[k].x);
                hi_x = std::max(hi_x, p[k].x);
                lo_y = std::min(lo_y, p[k].y);
                hi_y = std::max(hi_y, p[k].y);
            }
            Triangle t;
            if (!crossing) {
                if (!sample_range(lo_x, hi_x, columns_, t.x0, t.x1) || !sample_range(lo_y, hi_y, rows_, t.y0, t.y1))
                    continue;
            } else {
                if (!(p[0].w > 0) && !(p[1].w > 0) && !(p[2].w > 0)) continue;
                t.x0 = t.y0 = 0;
                t.x1 = columns_ - 1;
                t.y1 = rows_ - 1;
            }
            const float *rgba[3];
            for (int k = 0; k < 3; ++k) rgba[k] = mesh.colors + 4 * (int64_t)corner[k];
            if (rgba[0][3] == 0 && rgba[1][3] == 0 && rgba[2][3] == 0) continue;
            Vec3 v[3];
            if (crossing) scene_.homogeneous(corner, x0_, y0_, v);
            if (!set_up(t, p, crossing ? v : nullptr, scene_.projection.near, rgba)) continue;
            t.face = f;
            bool shared_depth = mesh.depth_group && mesh.depth_group[f] >= 0;
            if (shared_depth) {
                const DepthPlane &plane = scene_.planes[mesh.depth_group[f]];
                t.ka = (float)plane.q.a;
                t.kb = (float)plane.q.b;
                t.kc = (float)(plane.q.c + plane.q.a * x0_ + plane.q.b * y0_);
                t.k_min = plane.q_min;
                t.k_max = plane.q_max;
            }
            if (crossing || shared_depth || PLACES)
                add_triangle<PLACES, true>(t, crossing, shared_depth);
            else
                add_triangle<PLACES, false>(t, false, false);
        }
    }

    // Adds the fragments of a triangle to the lists of the samples it covers.
    template <bool PLACES, bool GENERAL>
    void add_triangle(const Triangle &t, bool crossing, bool shared_depth) {
        alignas(64) float base[4][TILE];
        for (int x = 0; x < TILE; x += W) {
            vf row = load(center_ + x);
            for (int i = 0; i < 3; ++i) store(base[i] + x, set1(t.eb[i]) * row + set1(t.ec[i]));
            store(base[3] + x, set1(t.qb) * row + set1(t.qc));
        }
        int n = 0;
        for (int x = t.x0 / W * W; x <= t.x1; x += W) {
            vf column = load(center_ + x), ex[3];
            for (int i = 0; i < 3; ++i) ex[i] = set1(t.ea[i]) * column;
            vf qx = set1(t.qa) * column;
            unsigned columns = ((2u << (t.x1 - x)) - 1) & ((1u << W) - 1);
            for (int y = t.y0; y <= t.y1; ++y) {
                vf e[3];
                for (int i = 0; i < 3; ++i) e[i] = ex[i] + set1(base[i][y]);
                unsigned inside = at_least(e[0], set1(t.threshold[0])) & at_least(e[1], set1(t.threshold[1])) &
                                  at_least(e[2], set1(t.threshold[2])) & columns & (open_[y] >> x);
                vf q = qx + set1(base[3][y]);
                if (GENERAL && crossing) inside &= at_least(set1(t.q_max), q);
                compress(found_.x + n, column, inside);
                compress(found_.q + n, q, inside);
                if (PLACES)
                    for (int i = 0; i < 3; ++i) compress(found_.e[i] + n, e[i] * set1(t.weight[i]), inside);
                int more = __builtin_popcount(inside);
                store(found_.y + n, set1(center_[y]));
                n += more;
            }
        }
        if (n == 0) return;
        pending_ += n;
        for (int i = 0; i < n; i += W) {
            vf q = vmin(vmax(load(found_.q + i), set1(t.q_min)), set1(t.q_max));
            store(found_.z + i, set1(1.0f) / q);
            if (GENERAL && shared_depth) {
                q = set1(t.ka) * load(found_.x + i) + (set1(t.kb) * load(found_.y + i) + set1(t.kc));
                q = vmin(vmax(q, set1(t.k_min)), set1(t.k_max));
            }
            store(found_.q + i, q);
        }
        for (int i = 0; i < n; ++i) {
            float x = found_.x[i], y = found_.y[i];
            int sample = (int)y * TILE + (int)x;
            f4 rgba = (t.vc + t.vb * set4(y) + t.va * set4(x)) * set4(found_.z[i]);
            rgba = min4(max4(rgba, t.low), t.high);
            int k = count_[sample]++;
            Place place;
            if (PLACES) {
                float sum = found_.e[0][i] + found_.e[1][i] + found_.e[2][i];
                place = {{1, 0, 0}, found_.z[i]};
                if (sum > 0)
                    for (int j = 0; j < 3; ++j) place.b[j] = found_.e[j][i] / sum;
            }
            if (__builtin_expect(k < ROOM, 1)) {
                arena_->key[sample][k] = found_.q[i];
                arena_->face[sample][k] = t.face;
                store4(arena_->rgba[sample][k], rgba);
                if (PLACES) arena_->place[sample][k] = place;
            } else {
                overflow_[sample].push_back({rgba, found_.q[i], t.face, place});
            }
        }
    }

    // Blends all waiting fragments nearer than anything with 1 / depth <= key; true once no sample takes more light.
    bool flush(float key) {
        pending_ = 0;
        uint32_t any_open = 0;
        for (int y = 0; y < rows_; ++y) {
            for (uint32_t row = open_[y]; row; row &= row - 1) {
                int x = __builtin_ctz(row), sample = y * TILE + x;
                if (count_[sample] == 0) continue;
                if (blend(sample, key)) {
                    open_[y] &= ~(1u << x);
                    count_[sample] = 0;
                } else {
                    pending_ += count_[sample];
                }
            }
            any_open |= open_[y];
        }
        // Fragments that had to wait should not be sorted again and again.
        limit_ = std::max<int64_t>((int64_t)PER_SAMPLE * rows_ * columns_, 2 * pending_);
        return any_open == 0;
    }

    // Writes the order of n fragments to order_: nearest first, equal depths by face number.
    // `key` must be readable up to a multiple of W.
    void sort(const float *key, const int32_t *face, int n) {
        size_t padded = (n + W - 1) / W * W;
        if (order_.size() < padded) {
            order_.resize(padded);
            rank_.resize(padded);
        }
        if (n > 128) {
            for (int i = 0; i < n; ++i) order_[i] = i;
            std::sort(order_.begin(), order_.begin() + n,
                      [&](int a, int b) { return key[a] != key[b] ? key[a] > key[b] : face[a] < face[b]; });
            return;
        }
        typedef int32_t vi __attribute__((vector_size(4 * W)));
        for (int j = 0; j < n; j += W) {
            vf mine = load(key + j);
            vi rank = {};
            for (int i = 0; i < n; ++i) rank -= set1(key[i]) > mine;
            __builtin_memcpy(&rank_[j], &rank, sizeof rank);
        }
        int total = 0;
        for (int i = 0; i < n; ++i) {
            order_[rank_[i]] = i;
            total += rank_[i];
        }
        // Without ties each pair adds one to the sum of ranks.
        if (total != n * (n - 1) / 2) {
            for (int i = 0; i < n; ++i) {
                int rank = 0;
                for (int k = 0; k < n; ++k) rank += key[k] > key[i] || (key[k] == key[i] && face[k] < face[i]);
                order_[rank] = i;
            }
        }
    }

    // Blends the front of one sample's fragments and keeps the rest; true if the sample takes no more light.
    bool blend(int sample, float nearest_to_come) {
        int n = count_[sample];
        float *key = arena_->key[sample], *rgba = arena_->rgba[sample][0];
        int32_t *face = arena_->face[sample];
        Place *place = arena_->place[sample];
        if (n > ROOM) {
            gather(sample);
            key = long_.key.data();
            rgba = long_.rgba.data();
            face = long_.face.data();
            place = long_.place.data();
        }
        sort(key, face, n);
        f4 color = color_[sample];
        float through = through_[sample];
        int done = 0;
        bool closed = false;
        for (; done < n; ++done) {
            int i = order_[done];
            if (!(key[i] > nearest_to_come)) break;
            f4 c = load4(rgba + 4 * i);
            float alpha = c[3];
            if (!(alpha > 0)) continue;
            float weight = through * alpha;
            color += set4(weight) * c;
            through -= weight;
            ++fragments_;
            if (extras_.any) add_extras(sample, face[i], place[i], weight);
            if (options_.max_layers && ++layers_[sample] >= options_.max_layers) closed = true;
            if (closed || through < options_.min_transmittance) {
                closed = true;
                break;
            }
        }
        color_[sample] = color;
        through_[sample] = through;
        if (closed) return true;

        // Moves what has to wait to the front, in order.
        int left = n - done;
        count_[sample] = left;
        if (n > ROOM) overflow_[sample].clear();
        if (left == 0 || (done == 0 && n <= ROOM)) return false;
        if ((int)kept_.size() < left) kept_.resize(left);
        for (int i = 0; i < left; ++i) {
            int from = order_[done + i];
            kept_[i].rgba = load4(rgba + 4 * from);
            kept_[i].key = key[from];
            kept_[i].face = face[from];
            if (extras_.any) kept_[i].place = place[from];
        }
        for (int i = 0; i < std::min(left, ROOM); ++i) {
            store4(arena_->rgba[sample][i], kept_[i].rgba);
            arena_->key[sample][i] = kept_[i].key;
            arena_->face[sample][i] = kept_[i].face;
            if (extras_.any) arena_->place[sample][i] = kept_[i].place;
        }
        if (left > ROOM) overflow_[sample].assign(kept_.begin() + ROOM, kept_.begin() + left);
        return false;
    }

    // Copies all fragments of a sample that has more than the arena holds to long_.
    void gather(int sample) {
        int n = count_[sample];
        long_.key.resize((n + W - 1) / W * W);
        long_.face.resize(n);
        long_.rgba.resize(4 * (size_t)n);
        long_.place.resize(n);
        for (int i = 0; i < n; ++i) {
            const bool inside = i < ROOM;
            const Fragment *f = inside ? nullptr : &overflow_[sample][i - ROOM];
            long_.key[i] = inside ? arena_->key[sample][i] : f->key;
            long_.face[i] = inside ? arena_->face[sample][i] : f->face;
            store4(&long_.rgba[4 * (size_t)i], inside ? load4(arena_->rgba[sample][i]) : f->rgba);
            if (extras_.any) long_.place[i] = inside ? arena_->place[sample][i] : f->place;
        }
    }

    void add_extras(int sample, int32_t face, const Place &place, float weight) {
        const MsMesh &mesh = scene_.mesh;
        float *sum = sums_.data() + (size_t)sample * extras_.channels;
        const int32_t *corner = mesh.faces + 3 * (int64_t)face;
        if (extras_.depth >= 0) sum[extras_.depth] += weight * place.z;
        if (extras_.normals >= 0) {
            double n[3] = {0, 0, 0};
            if (mesh.normals) {
                for (int k = 0; k < 3; ++k)
                    for (int c = 0; c < 3; ++c) n[c] += (double)place.b[k] * mesh.normals[3 * (int64_t)corner[k] + c];
            } else {
                const float *a = mesh.vertices + 3 * (int64_t)corner[0], *b = mesh.vertices + 3 * (int64_t)corner[1],
                            *c = mesh.vertices + 3 * (int64_t)corner[2];
                double u[3], v[3];
                for (int k = 0; k < 3; ++k) {
                    u[k] = (double)b[k] - a[k];
                    v[k] = (double)c[k] - a[k];
                }
                for (int k = 0; k < 3; ++k)
                    n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
            }
            // The ray through the sample, in the world.
            const Projection &pr = scene_.projection;
            double ray[3] = {(x0_ + sample % TILE + 0.5 - pr.cx) / pr.fx, (y0_ + sample / TILE + 0.5 - pr.cy) / pr.fy, 1};
            double along = 0, length = 0;
            for (int k = 0; k < 3; ++k) {
                along += n[k] * (pr.m[k] * ray[0] + pr.m[4 + k] * ray[1] + pr.m[8 + k] * ray[2]);
                length += n[k] * n[k];
            }
            if (length > 0) {
                double scale = (along > 0 ? -1 : 1) / std::sqrt(length) * weight;
                for (int k = 0; k < 3; ++k) sum[extras_.normals + k] += (float)(n[k] * scale);
            }
        }
        if (extras_.attributes >= 0) {
            int channels = mesh.attribute_count;
            for (int c = 0; c < channels; ++c) {
                float value = 0;
                for (int k = 0; k < 3; ++k) value += place.b[k] * mesh.attributes[(int64_t)corner[k] * channels + c];
                sum[extras_.attributes + c] += weight * value;
            }
        }
    }

    // Averages the samples of each pixel into the picture.
    void finish() {
        int s = grid_.samples;
        float share = 1.0f / (s * s);
        for (int y = 0; y < rows_; y += s) {
            for (int x = 0; x < columns_; x += s) {
                int64_t pixel = (int64_t)((y0_ + y) / s) * camera_.width + (x0_ + x) / s;
                f4 color = {};
                float through = 0;
                for (int j = 0; j < s; ++j)
                    for (int i = 0; i < s; ++i) {
                        color += color_[(y + j) * TILE + x + i];
                        through += through_[(y + j) * TILE + x + i];
                    }
                color *= set4(share);
                through *= share;
                const float *background = options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c) picture_.color[3 * pixel + c] = color[c] + through * background[c];
                picture_.alpha[pixel] = 1 - through;
                if (!extras_.any) continue;
                auto average = [&](float *out, int channel, int channels) {
                    for (int c = 0; c < channels; ++c) {
                        float sum = 0;
                        for (int j = 0; j < s; ++j)
                            for (int i = 0; i < s; ++i)
                                sum += sums_[(size_t)((y + j) * TILE + x + i) * extras_.channels + channel + c];
                        out[pixel * channels + c] = sum * share;
                    }
                };
                if (extras_.depth >= 0) average(picture_.depth, extras_.depth, 1);
                if (extras_.normals >= 0) average(picture_.normals, extras_.normals, 3);
                if (extras_.attributes >= 0) average(picture_.attributes, extras_.attributes, scene_.mesh.attribute_count);
            }
        }
    }
};

}  // namespace ms
