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
        for (int i = 0; i < TILE; ++i) {
            center_[i] = i + 0.5f;
            center4_[i] = set4(i + 0.5f);
        }
        for (int i = 0; i < SAMPLES; ++i) capacity_[i] = ROOM;
    }

    int64_t fragments() const { return fragments_; }

    void draw(int tile_x, int tile_y, const uint32_t *list, int64_t length) {
        begin(tile_x, tile_y);
        for (int64_t i = 0; i < length; ++i) {
            const Item &item = scene_.items[list[i]];
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
    static constexpr int ROOM = 32;      // fragments a sample before its list moves to the heap
    static constexpr int PER_SAMPLE = 8; // mean length of the lists at which they are flushed

    // The waiting fragments of one sample.
    struct List {
        float *key;
        int32_t *face;
        float *rgba;
        Place *place;
    };
    struct Arena {
        alignas(64) float key[SAMPLES][ROOM];
        alignas(64) int32_t face[SAMPLES][ROOM];
        alignas(64) float rgba[SAMPLES][ROOM][4];
        Place place[SAMPLES][ROOM];
    };
    // A list that outgrew the arena.
    struct Grown {
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
    std::unique_ptr<Grown> grown_[SAMPLES];

    alignas(64) float center_[TILE];
    f4 center4_[TILE];
    List list_[SAMPLES];
    int32_t count_[SAMPLES];
    int32_t capacity_[SAMPLES];
    int32_t layers_[SAMPLES];
    f4 color_[SAMPLES];
    float through_[SAMPLES];
    uint32_t open_[TILE];  // per row, the samples that still take light
    std::vector<float> sums_;
    std::vector<int32_t> order_, rank_;
    std::vector<float> key_copy_;
    std::vector<Place> place_copy_;
    std::vector<f4> rgba_copy_;
    std::vector<int32_t> face_copy_;

    int x0_, y0_, columns_, rows_;  // the tile in samples
    int64_t pending_, limit_, fragments_ = 0;

    void begin(int tile_x, int tile_y) {
        x0_ = tile_x * grid_.side;
        y0_ = tile_y * grid_.side;
        columns_ = std::min(grid_.side, grid_.width - x0_);
        rows_ = std::min(grid_.side, grid_.height - y0_);
        for (int i = 0; i < SAMPLES; ++i) {
            if (grown_[i]) grown_[i].reset();
            list_[i] = {arena_->key[i], arena_->face[i], arena_->rgba[i][0], arena_->place[i]};
            capacity_[i] = ROOM;
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
        for (int x = t.x0 / W * W; x <= t.x1; x += W) {
            vf column = load(center_ + x);
            vf ex[3];
            for (int i = 0; i < 3; ++i) ex[i] = set1(t.ea[i]) * column;
            vf qx = set1(t.qa) * column;
            unsigned columns = ((2u << (t.x1 - x)) - 1) & ((1u << W) - 1);
            for (int y = t.y0; y <= t.y1; ++y) {
                float row = y + 0.5f;
                vf e[3];
                for (int i = 0; i < 3; ++i) e[i] = ex[i] + set1(t.eb[i] * row + t.ec[i]);
                unsigned inside = at_least(e[0], set1(t.threshold[0])) & at_least(e[1], set1(t.threshold[1])) &
                                  at_least(e[2], set1(t.threshold[2])) & columns & (open_[y] >> x);
                if (!inside) continue;
                vf q = qx + set1(t.qb * row + t.qc);
                if (GENERAL && crossing) {
                    inside &= at_least(set1(t.q_max), q);
                    if (!inside) continue;
                }
                q = vmin(vmax(q, set1(t.q_min)), set1(t.q_max));
                vf z = set1(1.0f) / q;
                alignas(64) float keys[W], depths[W], edges[3][W];
                if (GENERAL && shared_depth) {
                    vf k = set1(t.ka) * column + set1(t.kb * row + t.kc);
                    store(keys, vmin(vmax(k, set1(t.k_min)), set1(t.k_max)));
                } else {
                    store(keys, q);
                }
                store(depths, z);
                if (PLACES)
                    for (int i = 0; i < 3; ++i) store(edges[i], e[i] * set1(t.weight[i]));
                f4 value = t.vb * set4(row) + t.vc;
                pending_ += __builtin_popcount(inside);
                for (; inside; inside &= inside - 1) {
                    int lane = __builtin_ctz(inside);
                    int sample = y * TILE + x + lane;
                    int n = count_[sample]++;
                    if (__builtin_expect(n >= capacity_[sample], 0)) grow(sample);
                    List &list = list_[sample];
                    f4 rgba = (value + t.va * center4_[x + lane]) * set4(depths[lane]);
                    store4(list.rgba + 4 * n, min4(max4(rgba, t.low), t.high));
                    list.key[n] = keys[lane];
                    list.face[n] = t.face;
                    if (PLACES) {
                        float sum = edges[0][lane] + edges[1][lane] + edges[2][lane];
                        Place place = {{1, 0, 0}, depths[lane]};
                        if (sum > 0)
                            for (int i = 0; i < 3; ++i) place.b[i] = edges[i][lane] / sum;
                        list.place[n] = place;
                    }
                }
            }
        }
    }

    void grow(int sample) {
        int32_t room = capacity_[sample];
        auto larger = std::make_unique<Grown>();
        size_t size = 2 * (size_t)room;
        larger->key.resize(size);
        larger->face.resize(size);
        larger->rgba.resize(4 * size);
        if (extras_.any) larger->place.resize(size);
        List &list = list_[sample];
        std::copy(list.key, list.key + room, larger->key.begin());
        std::copy(list.face, list.face + room, larger->face.begin());
        std::copy(list.rgba, list.rgba + 4 * (size_t)room, larger->rgba.begin());
        if (extras_.any) std::copy(list.place, list.place + room, larger->place.begin());
        list = {larger->key.data(), larger->face.data(), larger->rgba.data(),
                extras_.any ? larger->place.data() : nullptr};
        capacity_[sample] = (int32_t)size;
        grown_[sample] = std::move(larger);
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

    // Ranks the n fragments of a list: nearest first, equal depths by face number.
    void sort(const List &list, int n) {
        int padded = (n + W - 1) / W * W;
        if ((int)order_.size() < padded) {
            order_.resize(padded);
            rank_.resize(padded);
            key_copy_.resize(padded);
        }
        if (n > 128) {
            for (int i = 0; i < n; ++i) order_[i] = i;
            std::sort(order_.begin(), order_.begin() + n, [&](int a, int b) {
                return list.key[a] != list.key[b] ? list.key[a] > list.key[b] : list.face[a] < list.face[b];
            });
            return;
        }
        const float *keys = list.key;
        typedef int32_t vi __attribute__((vector_size(4 * W)));
        int total = 0;
        for (int j = 0; j < padded; j += W) {
            vf mine = load(keys + j);
            vi rank = {};
            for (int i = 0; i < n; ++i) rank -= set1(keys[i]) > mine;
            __builtin_memcpy(&rank_[j], &rank, sizeof rank);
        }
        for (int i = 0; i < n; ++i) {
            order_[rank_[i]] = i;
            total += rank_[i];
        }
        // Without ties each pair adds one to the sum of ranks.
        if (total != n * (n - 1) / 2) {
            for (int i = 0; i < n; ++i) {
                int rank = 0;
                for (int k = 0; k < n; ++k)
                    rank += keys[k] > keys[i] || (keys[k] == keys[i] && list.face[k] < list.face[i]);
                order_[rank] = i;
            }
        }
    }

    // Blends the front of one sample's list and keeps the rest; true if the sample takes no more light.
    bool blend(int sample, float key) {
        List &list = list_[sample];
        int n = count_[sample];
        if (n == 1)
            order_.resize(std::max<size_t>(order_.size(), W)), order_[0] = 0;
        else
            sort(list, n);
        f4 color = color_[sample];
        float through = through_[sample];
        int done = 0;
        bool closed = false;
        for (; done < n; ++done) {
            int i = order_[done];
            if (!(list.key[i] > key)) break;
            f4 rgba = load4(list.rgba + 4 * i);
            float alpha = rgba[3];
            if (!(alpha > 0)) continue;
            float weight = through * alpha;
            color += set4(weight) * rgba;
            through -= weight;
            ++fragments_;
            if (extras_.any) add_extras(sample, list.face[i], list.place[i], weight);
            if (options_.max_layers && ++layers_[sample] >= options_.max_layers) closed = true;
            if (closed || through < options_.min_transmittance) {
                closed = true;
                break;
            }
        }
        color_[sample] = color;
        through_[sample] = through;
        if (closed) return true;
        keep(list, sample, done, n);
        return false;
    }

    // Moves the fragments from `done` on in sorted order to the front of the list.
    void keep(List &list, int sample, int done, int n) {
        int left = n - done;
        count_[sample] = left;
        if (left == 0 || done == 0) return;
        key_copy_.resize(std::max<size_t>(key_copy_.size(), left));
        face_copy_.resize(std::max<size_t>(face_copy_.size(), left));
        rgba_copy_.resize(std::max<size_t>(rgba_copy_.size(), left));
        if (extras_.any) place_copy_.resize(std::max<size_t>(place_copy_.size(), left));
        for (int i = 0; i < left; ++i) {
            int from = order_[done + i];
            key_copy_[i] = list.key[from];
            face_copy_[i] = list.face[from];
            rgba_copy_[i] = load4(list.rgba + 4 * from);
            if (extras_.any) place_copy_[i] = list.place[from];
        }
        for (int i = 0; i < left; ++i) {
            list.key[i] = key_copy_[i];
            list.face[i] = face_copy_[i];
            store4(list.rgba + 4 * i, rgba_copy_[i]);
            if (extras_.any) list.place[i] = place_copy_[i];
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
