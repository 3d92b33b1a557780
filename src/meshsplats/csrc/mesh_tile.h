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
        for (int i = 0; i < 16; ++i) {
            lane_x_[i] = i % 4 + 0.5f;
            lane_y_[i] = i / 4 + 0.5f;
            block_x_[i] = 4.0f * (i % 4);
            block_y_[i] = 4.0f * (i / 4);
        }
    }

    int64_t fragments() const { return fragments_; }

    void draw(int tile_x, int tile_y, const Entry *list, int64_t length) {
        begin(tile_x, tile_y);
        for (int64_t i = 0; i < length; ++i) {
            if (i + 8 < length) prefetch_faces(list[i + 8]);
            if (i + 4 < length) prefetch_corners(list[i + 4]);
            if (pending_ >= limit_ && flush(list[i].key)) break;
            if (extras_.any)
                add_run<true>(list[i]);
            else
                add_run<false>(list[i]);
        }
        flush(-1);
        finish();
    }

  private:
    // Samples are numbered by blocks of 4 x 4: sample = 16 block + 4 row + column, a block being one wide vector.
    static constexpr int SAMPLES = TILE * TILE;
    static constexpr int BLOCKS = SAMPLES / 16;
    static constexpr float SLACK = 0.01f;
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
        alignas(64) int32_t sample[SAMPLES + W];
        alignas(64) float q[SAMPLES + W], z[SAMPLES + W], e[3][SAMPLES + W];
        alignas(64) float rgba[SAMPLES + W][4];
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

    Triangles triangles_;
    alignas(64) float lane_x_[16], lane_y_[16];           // of a block's samples, from the block's corner
    alignas(64) float block_x_[BLOCKS], block_y_[BLOCKS];  // of the blocks' corners, from the tile's
    int32_t count_[SAMPLES];
    int32_t layers_[SAMPLES];
    f4 color_[SAMPLES];
    float through_[SAMPLES];
    uint32_t open_[BLOCKS];  // per block, the samples that still take light
    std::vector<float> sums_;
    std::vector<int32_t> order_, rank_;
    std::vector<Fragment> kept_;

    int x0_, y0_, columns_, rows_;  // the tile in samples
    int64_t pending_, limit_, fragments_ = 0;

    static int number(int x, int y) { return (y / 4 * 4 + x / 4) * 16 + y % 4 * 4 + x % 4; }
    static int column(int sample) { return sample / 16 % 4 * 4 + sample % 4; }
    static int row(int sample) { return sample / 64 * 4 + sample / 4 % 4; }

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
        std::fill(open_, open_ + BLOCKS, 0);
        for (int y = 0; y < rows_; ++y)
            for (int x = 0; x < columns_; ++x) open_[number(x, y) / 16] |= 1u << number(x, y) % 16;
        std::fill(sums_.begin(), sums_.end(), 0.0f);
        pending_ = 0;
        limit_ = (int64_t)PER_SAMPLE * rows_ * columns_;
    }

    // Groups come in the order of depth, which is no order in memory: their data is asked for some groups ahead.
    void prefetch_faces(const Entry &run) const {
        const int32_t *face = scene_.mesh.faces + 3 * (int64_t)run.first;
        __builtin_prefetch(face);
        __builtin_prefetch(face + 16);
    }
    void prefetch_corners(const Entry &run) const {
        const int32_t *face = scene_.mesh.faces + 3 * (int64_t)run.first;
        for (int i = 0; i < run.length; ++i, face += 3) {
            __builtin_prefetch(&scene_.vertices[face[1]]);
            __builtin_prefetch(scene_.mesh.colors + 4 * (int64_t)face[1]);
        }
    }

    template <bool PLACES>
    void add_run(const Entry &run) {
        const MsMesh &mesh = scene_.mesh;
        Triangles &t = triangles_;
        const int32_t end = run.first + run.length;
        for (int32_t f = run.first; f < end;) {
            int n = 0;
            unsigned crossing = 0;
            for (; f < end && n < Triangles::N; ++f) {
                const int32_t *corner = mesh.faces + 3 * (int64_t)f;
                const Projected &p0 = scene_.vertices[corner[0]], &p1 = scene_.vertices[corner[1]],
                                &p2 = scene_.vertices[corner[2]];
                bool behind[3] = {!(p0.w > 0), !(p1.w > 0), !(p2.w > 0)};
                if (behind[0] & behind[1] & behind[2]) continue;
                const Projected *p[3] = {&p0, &p1, &p2};
                for (int k = 0; k < 3; ++k) {
                    t.x[k][n] = p[k]->x - x0_;
                    t.y[k][n] = p[k]->y - y0_;
                    t.w[k][n] = p[k]->w;
                    t.rgba[k][n] = mesh.colors + 4 * (int64_t)corner[k];
                }
                t.face[n] = f;
                if (behind[0] | behind[1] | behind[2]) crossing |= 1u << n;
                ++n;
            }
            t.set_up_in_front();
            for (unsigned rest = crossing; rest; rest &= rest - 1) {
                int k = __builtin_ctz(rest);
                Vec3 v[3];
                scene_.homogeneous(mesh.faces + 3 * (int64_t)t.face[k], x0_, y0_, v);
                t.set_up_crossing(k, v, scene_.projection.near);
            }
            for (int k = 0; k < n; ++k) {
                // The slack is more than the rounding of an edge function.
                bool near_tile = (t.area[k] > 0) & (t.low_x[k] < columns_ + SLACK) & (t.high_x[k] > -SLACK) &
                                 (t.low_y[k] < rows_ + SLACK) & (t.high_y[k] > -SLACK);
                if (!near_tile) continue;
                bool shared_depth = mesh.depth_group && mesh.depth_group[t.face[k]] >= 0;
                bool crosses = crossing >> k & 1;
                if (crosses || shared_depth || PLACES)
                    add_triangle<PLACES, true>(k, crosses, shared_depth);
                else
                    add_triangle<PLACES, false>(k, false, false);
            }
        }
    }

    // Adds the fragments of a triangle to the lists of the samples it covers.
    template <bool PLACES, bool GENERAL>
    void add_triangle(int k, bool crossing, bool shared_depth) {
        const Triangles &t = triangles_;
        // Each linear function is (a x + b y inside a block) + (a x + b y + c at the block's corner).
        constexpr int PARTS = 16 / W;
        vf inside_block[4][PARTS];
        alignas(64) float at_block[4][BLOCKS];
        unsigned blocks = (1u << BLOCKS) - 1;
        for (int i = 0; i < 4; ++i) {
            float a = i < 3 ? t.ea[i][k] : t.qa[k], b = i < 3 ? t.eb[i][k] : t.qb[k], c = i < 3 ? t.ec[i][k] : t.qc[k];
            vf va = set1(a), vb = set1(b), vc = set1(c);
            for (int part = 0; part < PARTS; ++part)
                inside_block[i][part] = va * load(lane_x_ + part * W) + vb * load(lane_y_ + part * W);
            for (int j = 0; j < BLOCKS; j += W)
                store(at_block[i] + j, va * load(block_x_ + j) + (vb * load(block_y_ + j) + vc));
            if (i == 3) continue;
            // No sample of a block exceeds its corner's value by more than this, rounding included.
            float most = std::max(a * 0.5f, a * 3.5f) + std::max(b * 0.5f, b * 3.5f);
            unsigned touched = 0;
            for (int j = 0; j < BLOCKS; j += W)
                touched |= at_least(load(at_block[i] + j) + set1(most), set1(t.threshold[i][k])) << j;
            blocks &= touched;
        }
        int n = 0;
        vf q_max = set1(t.q_max[k]);
        for (; blocks; blocks &= blocks - 1) {
            int block = __builtin_ctz(blocks);
            for (int part = 0; part < PARTS; ++part) {
                vf e[3];
                unsigned inside = open_[block] >> (part * W) & ((1u << W) - 1);
                for (int i = 0; i < 3; ++i) {
                    e[i] = inside_block[i][part] + set1(at_block[i][block]);
                    inside &= at_least(e[i], set1(t.threshold[i][k]));
                }
                vf q = inside_block[3][part] + set1(at_block[3][block]);
                if (GENERAL && crossing) inside &= at_least(q_max, q);
                compress(found_.q + n, q, inside);
                compress_numbers(found_.sample + n, block * 16 + part * W, inside);
                if (PLACES)
                    for (int i = 0; i < 3; ++i) compress(found_.e[i] + n, e[i] * set1(t.weight[i][k]), inside);
                n += __builtin_popcount(inside);
            }
        }
        if (n == 0) return;
        pending_ += n;

        f4 c[3] = {load4(t.rgba[0][k]), load4(t.rgba[1][k]), load4(t.rgba[2][k])};
        auto mix = [&](const float s[3][Triangles::N]) {
            return set4(s[0][k]) * c[0] + set4(s[1][k]) * c[1] + set4(s[2][k]) * c[2];
        };
        f4 va = mix(t.sa), vb = mix(t.sb), vc = mix(t.sc);
        f4 low = min4(min4(c[0], c[1]), c[2]), high = max4(max4(c[0], c[1]), c[2]);
        vf q_min = set1(t.q_min[k]);
        typedef int32_t vi __attribute__((vector_size(4 * W)));
        for (int i = 0; i < n; i += W) {
            vi sample;
            __builtin_memcpy(&sample, found_.sample + i, sizeof sample);
            vf x = __builtin_convertvector(((sample >> 2) & 12) + (sample & 3), vf) + set1(0.5f);
            vf y = __builtin_convertvector(((sample >> 4) & 12) + ((sample >> 2) & 3), vf) + set1(0.5f);
            vf q = vmin(vmax(load(found_.q + i), q_min), q_max);
            vf z = set1(1.0f) / q;
            vf value[4];
            for (int j = 0; j < 4; ++j) {
                value[j] = (set1(vc[j]) + set1(vb[j]) * y + set1(va[j]) * x) * z;
                value[j] = vmin(vmax(value[j], set1(low[j])), set1(high[j]));
            }
            interleave4(found_.rgba[i], value[0], value[1], value[2], value[3]);
            if (GENERAL && shared_depth) {
                const DepthPlane &plane = scene_.planes[scene_.mesh.depth_group[t.face[k]]];
                double corner = plane.q.c + plane.q.a * x0_ + plane.q.b * y0_;
                q = set1((float)plane.q.a) * x + (set1((float)plane.q.b) * y + set1((float)corner));
                q = vmin(vmax(q, set1(plane.q_min)), set1(plane.q_max));
            }
            store(found_.q + i, q);
            if (PLACES) store(found_.z + i, z);
        }
        for (int i = 0; i < n; ++i) {
            int sample = found_.sample[i];
            f4 rgba = load4(found_.rgba[i]);
            int waiting = count_[sample]++;
            Place place;
            if (PLACES) {
                float sum = found_.e[0][i] + found_.e[1][i] + found_.e[2][i];
                place = {{1, 0, 0}, found_.z[i]};
                if (sum > 0)
                    for (int j = 0; j < 3; ++j) place.b[j] = found_.e[j][i] / sum;
            }
            if (__builtin_expect(waiting < ROOM, 1)) {
                arena_->key[sample][waiting] = found_.q[i];
                arena_->face[sample][waiting] = t.face[k];
                store4(arena_->rgba[sample][waiting], rgba);
                if (PLACES) arena_->place[sample][waiting] = place;
            } else {
                overflow_[sample].push_back({rgba, found_.q[i], t.face[k], place});
            }
        }
    }

    // Blends all waiting fragments nearer than anything with 1 / depth <= key; true once no sample takes more light.
    bool flush(float key) {
        pending_ = 0;
        uint32_t any_open = 0;
        const bool plain = !extras_.any && !options_.max_layers;
        for (int block = 0; block < BLOCKS; ++block) {
            for (uint32_t rest = open_[block]; rest; rest &= rest - 1) {
                int lane = __builtin_ctz(rest), sample = 16 * block + lane;
                if (count_[sample] == 0) continue;
                if (plain ? blend<true>(sample, key) : blend<false>(sample, key)) {
                    open_[block] &= ~(1u << lane);
                    count_[sample] = 0;
                } else {
                    pending_ += count_[sample];
                }
            }
            any_open |= open_[block];
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
    template <bool PLAIN>
    bool blend(int sample, float nearest_to_come) {
        int n = count_[sample];
        float *key = arena_->key[sample], *rgba = arena_->rgba[sample][0];
        int32_t *face = arena_->face[sample];
        Place *place = arena_->place[sample];
        if (__builtin_expect(n > ROOM, 0)) {
            gather(sample);
            key = long_.key.data();
            rgba = long_.rgba.data();
            face = long_.face.data();
            place = long_.place.data();
        }
        sort(key, face, n);
        f4 color = color_[sample];
        float through = through_[sample];
        const float least = options_.min_transmittance;
        int done = 0, blended = 0;
        bool closed = false;
        for (; done < n; ++done) {
            int i = order_[done];
            if (!(key[i] > nearest_to_come)) break;
            f4 c = load4(rgba + 4 * i);
            float alpha = c[3];
            float weight = through * alpha;
            color += set4(weight) * c;
            through -= weight;
            blended += alpha > 0;
            if (!PLAIN && alpha > 0) {
                if (extras_.any) add_extras(sample, face[i], place[i], weight);
                closed = options_.max_layers && ++layers_[sample] >= options_.max_layers;
            }
            closed |= through < least;
            if (closed) break;
        }
        color_[sample] = color;
        through_[sample] = through;
        fragments_ += blended;
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
            double ray[3] = {(x0_ + column(sample) + 0.5 - pr.cx) / pr.fx, (y0_ + row(sample) + 0.5 - pr.cy) / pr.fy, 1};
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
                        color += color_[number(x + i, y + j)];
                        through += through_[number(x + i, y + j)];
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
                                sum += sums_[(size_t)number(x + i, y + j) * extras_.channels + channel + c];
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
