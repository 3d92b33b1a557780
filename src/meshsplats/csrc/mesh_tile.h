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
          extras_(picture, scene.mesh), arena_(new Arena()), sums_((size_t)SAMPLES * extras_.channels) {
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
    static constexpr int SIDE_BY_SIDE = 16;  // fragments a sample at most where W samples are sorted at once
    static constexpr int PER_SAMPLE = 8;  // mean number of waiting fragments at which they are flushed

    // The waiting fragments of all samples, the k-th of every sample side by side. Rows are padded: rows that start a
    // power of two apart would compete for the same few lines of the cache.
    struct Layer {
        alignas(64) float key[SAMPLES + 16];
        alignas(64) float rgba[4][SAMPLES + 16];
        alignas(64) int32_t face[SAMPLES + 16];
    };
    // Zeroed when made: what lies beyond a list is multiplied by a weight of 0 and must be finite.
    struct Arena {
        Layer layer[ROOM];
        Place place[ROOM][SAMPLES];
    };
    struct Fragment {
        float rgba[4];
        float key;
        int32_t face;
        Place place;
    };
    // The samples that one triangle covers, side by side.
    struct Found {
        alignas(64) int32_t sample[SAMPLES + W];
        alignas(64) float q[SAMPLES + W], z[SAMPLES + W], b[3][SAMPLES + W];
        alignas(64) float rgba[4][SAMPLES + W];
    };
    const Scene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsPicture &picture_;
    const MsCamera &camera_;
    Extras extras_;
    std::unique_ptr<Arena> arena_;
    std::vector<Fragment> overflow_[SAMPLES];
    std::vector<Fragment> long_;
    Found found_;

    Triangles triangles_;
    alignas(64) float lane_x_[16], lane_y_[16];           // of a block's samples, from the block's corner
    alignas(64) float block_x_[BLOCKS], block_y_[BLOCKS];  // of the blocks' corners, from the tile's
    int32_t count_[SAMPLES];
    int32_t layers_[SAMPLES];
    alignas(64) float color_[3][SAMPLES];
    alignas(64) float through_[SAMPLES];
    uint32_t open_[BLOCKS];  // per block, the samples that still take light
    std::vector<float> sums_;
    std::vector<int32_t> order_;

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
            color_[0][i] = color_[1][i] = color_[2][i] = 0;
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
            if (PLACES) {
                store(found_.z + i, z);
                for (int j = 0; j < 3; ++j) {
                    vf b = (set1(t.sc[j][k]) + set1(t.sb[j][k]) * y + set1(t.sa[j][k]) * x) * z;
                    store(found_.b[j] + i, vmin(vmax(b, set1(0.0f)), set1(1.0f)));
                }
            }
            for (int j = 0; j < 4; ++j) {
                vf value = (set1(vc[j]) + set1(vb[j]) * y + set1(va[j]) * x) * z;
                store(found_.rgba[j] + i, vmin(vmax(value, set1(low[j])), set1(high[j])));
            }
            if (GENERAL && shared_depth) {
                const DepthPlane &plane = scene_.planes[scene_.mesh.depth_group[t.face[k]]];
                double corner = plane.q.c + plane.q.a * x0_ + plane.q.b * y0_;
                q = set1((float)plane.q.a) * x + (set1((float)plane.q.b) * y + set1((float)corner));
                q = vmin(vmax(q, set1(plane.q_min)), set1(plane.q_max));
            }
            store(found_.q + i, q);
        }
        for (int i = 0; i < n; ++i) {
            int sample = found_.sample[i];
            int waiting = count_[sample]++;
            Place place;
            if (PLACES) {
                float sum = found_.b[0][i] + found_.b[1][i] + found_.b[2][i];
                place = {{1, 0, 0}, found_.z[i]};
                if (sum > 0)
                    for (int j = 0; j < 3; ++j) place.b[j] = found_.b[j][i] / sum;
            }
            if (__builtin_expect(waiting < ROOM, 1)) {
                arena_->layer[waiting].key[sample] = found_.q[i];
                for (int j = 0; j < 4; ++j) arena_->layer[waiting].rgba[j][sample] = found_.rgba[j][i];
                arena_->layer[waiting].face[sample] = t.face[k];
                if (PLACES) arena_->place[waiting][sample] = place;
            } else {
                overflow_[sample].push_back(
                    {{found_.rgba[0][i], found_.rgba[1][i], found_.rgba[2][i], found_.rgba[3][i]}, found_.q[i], t.face[k], place});
            }
        }
    }

    // Blends all waiting fragments nearer than anything with 1 / depth <= key; true once no sample takes more light.
    bool flush(float key) {
        const bool plain = !extras_.any && !options_.max_layers;
        pending_ = 0;
        uint32_t any_open = 0;
        for (int first = 0; first < SAMPLES; first += W) {
            uint32_t open = open_[first / 16] >> (first % 16) & ((1u << W) - 1);
            int longest = 0;
            for (int i = 0; i < W; ++i) longest = std::max(longest, count_[first + i]);
            if (longest > 0 && !(plain && longest <= SIDE_BY_SIDE && blend_side_by_side(first, longest, key)))
                for (uint32_t rest = open; rest; rest &= rest - 1) blend(first + __builtin_ctz(rest), key);
            for (int i = 0; i < W; ++i) pending_ += count_[first + i];
            any_open |= open_[first / 16];
        }
        // Fragments that had to wait should not be sorted again and again.
        limit_ = std::max<int64_t>((int64_t)PER_SAMPLE * rows_ * columns_, 2 * pending_);
        return any_open == 0;
    }

    void close(int sample) {
        open_[sample / 16] &= ~(1u << sample % 16);
        count_[sample] = 0;
    }

    // Sorts and blends the fragments of W samples at once, at most `longest` each. Equal depths at a sample need the
    // face numbers to decide: then nothing is done and false returned.
    bool blend_side_by_side(int first, int longest, float nearest_to_come) {
        vf key[SIDE_BY_SIDE], rank[SIDE_BY_SIDE];
        alignas(64) float counts[W];
        for (int i = 0; i < W; ++i) counts[i] = (float)count_[first + i];
        const vf count = load(counts), one = set1(1), none = set1(-1);
        for (int i = 0; i < longest; ++i) {
            key[i] = pick(greater(count, set1((float)i)), load(arena_->layer[i].key + first), none);
            rank[i] = set1((float)i);
            for (int j = 0; j < i; ++j) {
                vm nearer = greater(key[i], key[j]);
                rank[i] = add_where(rank[i], nearer, none);
                rank[j] = add_where(rank[j], nearer, one);
            }
        }
        vf color[3], through = load(through_ + first), blended = set1(0), last = none;
        for (int c = 0; c < 3; ++c) color[c] = load(color_[c] + first);
        const vf least = set1(options_.min_transmittance), limit = set1(nearest_to_come), below = set1(-0.5f);
        unsigned tie = 0;
        int64_t fragments = 0;
        for (int r = 0; r < longest; ++r) {
            vf mine = none, rgba[4] = {set1(0), set1(0), set1(0), set1(0)};
            for (int i = 0; i < longest; ++i) {
                vm here = equal(rank[i], set1((float)r));
                mine = pick(here, key[i], mine);
                for (int c = 0; c < 4; ++c) rgba[c] = pick(here, load(arena_->layer[i].rgba[c] + first), rgba[c]);
            }
            tie |= bits(both(equal(mine, last), greater(mine, below)));
            last = mine;
            vm blends = both(greater(mine, limit), not_less(through, least));
            unsigned any = bits(blends);
            if (!any) {
                    break;
            }
            vf weight = pick(blends, through * rgba[3], set1(0));
            for (int c = 0; c < 3; ++c) color[c] += weight * rgba[c];
            through -= weight;
            blended = add_where(blended, blends, one);
            fragments += __builtin_popcount(bits(greater(weight, set1(0))));
        }
        if (tie) return false;
        fragments_ += fragments;
        for (int c = 0; c < 3; ++c) store(color_[c] + first, color[c]);
        store(through_ + first, through);

        unsigned closed = bits(greater(least, through));
        for (unsigned rest = closed; rest; rest &= rest - 1) close(first + __builtin_ctz(rest));
        alignas(64) float ranks[SIDE_BY_SIDE][W];
        for (int i = 0; i < longest; ++i) store(ranks[i], rank[i]);
        alignas(64) float gone[W];
        store(gone, blended);
        // Closes the gaps in the lists of the samples where something has to wait.
        for (unsigned rest = bits(greater(count, blended)) & ~closed; rest; rest &= rest - 1) {
            int lane = __builtin_ctz(rest), sample = first + lane, n = count_[sample], to = 0;
            for (int i = 0; i < n; ++i) {
                if (ranks[i][lane] < gone[lane]) continue;
                if (to != i) {
                    arena_->layer[to].key[sample] = arena_->layer[i].key[sample];
                    arena_->layer[to].face[sample] = arena_->layer[i].face[sample];
                    for (int c = 0; c < 4; ++c) arena_->layer[to].rgba[c][sample] = arena_->layer[i].rgba[c][sample];
                }
                ++to;
            }
        }
        for (int i = 0; i < W; ++i)
            if (!(closed >> i & 1)) count_[first + i] -= (int)gone[i];
        return true;
    }

    // The same for one sample, whatever it needs and however long its list is.
    void blend(int sample, float nearest_to_come) {
        const int n = count_[sample];
        if (n == 0) return;
        std::vector<Fragment> &list = long_;
        list.resize(n);
        for (int i = 0; i < std::min(n, ROOM); ++i) {
            for (int c = 0; c < 4; ++c) list[i].rgba[c] = arena_->layer[i].rgba[c][sample];
            list[i].key = arena_->layer[i].key[sample];
            list[i].face = arena_->layer[i].face[sample];
            if (extras_.any) list[i].place = arena_->place[i][sample];
        }
        if (n > ROOM) {
            std::copy(overflow_[sample].begin(), overflow_[sample].end(), list.begin() + ROOM);
            overflow_[sample].clear();
        }
        order_.resize(n);
        for (int i = 0; i < n; ++i) order_[i] = i;
        std::sort(order_.begin(), order_.end(), [&](int a, int b) {
            return list[a].key != list[b].key ? list[a].key > list[b].key : list[a].face < list[b].face;
        });
        int done = 0;
        for (; done < n; ++done) {
            const Fragment &f = list[order_[done]];
            if (!(f.key > nearest_to_come)) break;
            float weight = through_[sample] * f.rgba[3];
            for (int c = 0; c < 3; ++c) color_[c][sample] += weight * f.rgba[c];
            through_[sample] -= weight;
            bool last = through_[sample] < options_.min_transmittance;
            if (weight > 0) {
                ++fragments_;
                if (extras_.any) add_extras(sample, f.face, f.place, weight);
                last |= options_.max_layers && ++layers_[sample] >= options_.max_layers;
            }
            if (last) return close(sample);
        }
        // What has to wait, in order. What is surely hidden behind it goes: else a pile of triangles that all begin near
        // the camera, where nothing can be blended before the last has come, would fill the memory.
        const float least = std::max(0.5f * options_.min_transmittance, 1e-30f);
        float through = through_[sample];
        int to = 0, layers_left = options_.max_layers ? options_.max_layers - layers_[sample] : n;
        for (int i = done; i < n; ++i) {
            const Fragment &f = list[order_[i]];
            // Half: more in front can only lower the light, but for the rounding of the last bit.
            if (through < least || to >= layers_left) break;
            if (!(f.rgba[3] > 0)) continue;
            through -= through * f.rgba[3];
            if (to >= ROOM) {
                overflow_[sample].push_back(f);
                ++to;
                continue;
            }
            for (int c = 0; c < 4; ++c) arena_->layer[to].rgba[c][sample] = f.rgba[c];
            arena_->layer[to].key[sample] = f.key;
            arena_->layer[to].face[sample] = f.face;
            if (extras_.any) arena_->place[to][sample] = f.place;
            ++to;
        }
        count_[sample] = to;
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
                float color[3] = {0, 0, 0}, through = 0;
                for (int j = 0; j < s; ++j)
                    for (int i = 0; i < s; ++i) {
                        int sample = number(x + i, y + j);
                        for (int c = 0; c < 3; ++c) color[c] += color_[c][sample];
                        through += through_[sample];
                    }
                through *= share;
                const float *background = options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c) picture_.color[3 * pixel + c] = color[c] * share + through * background[c];
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
