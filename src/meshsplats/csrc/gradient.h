// Backward pass: from image gradients to vertex gradients.
//
// With B_k, the radiance behind fragment k, B_k = a_{k+1} c_{k+1} + (1 - a_{k+1}) B_{k+1} and B = background
// at the end,
//     dC/dc_k = T_k a_k,  dC/da_k = T_k (c_k - B_k).
// B is found from back to front, so that nothing is divided by 1 - a and a = 1 needs no exception.
//
// Values are v = (sum_k s_k v_k) / (sum_k s_k) with s = A p, p = (x, y, 1), A the inverse of the matrix V of
// the corners in homogeneous sample coordinates. As ds = -A dV s, a gradient g of v gives, summed over
// samples p at depth z = 1 / sum s,
//     dL/dv_k = A_k . sum z g p,  dL/dV = -A^T G A^T,  G_k = sum z g (v_k - v) p^T.
// So each triangle only needs the sums (moments) of z g and z g v times 1, x and y. The triangles that a
// sample sees and their order are constants.
#pragma once

#include "ramp.h"
#include "scene.h"
#include "tape.h"

namespace ms {

// The vertex gradients of one tile. A vertex may occur more than once.
struct TileGradients {
    struct Sum {
        alignas(32) float position[4];  // camera or world space, see GradientTile; the last is padding
        float rgba[4];
    };
    // Vectors only grow: the first `count` elements are in use.
    PooledVector<int32_t> vertices;
    PooledVector<Sum> sums;
    PooledVector<float> attributes;  // (count, attribute_count)
    size_t count = 0;

    // Makes room to append `more` vertices.
    void reserve(size_t more, int channels) {
        if (vertices.size() >= count + more) return;
        vertices.resize(std::max(count + more, 2 * vertices.size()));
        sums.resize(vertices.size());
        attributes.resize(vertices.size() * channels);
    }
};

class GradientTile {
  public:
    GradientTile(const Scene &scene, const MsOptions &options, const MsCamera &camera,
                 const MsImageGradients &image_gradients)
        : scene_(scene),
          mesh_(scene.mesh),
          grid_(scene.grid),
          options_(options),
          camera_(camera),
          image_gradients_(image_gradients),
          attribute_channels_(image_gradients.attributes ? mesh_.attribute_count : 0),
          grad_attributes_((size_t)attribute_channels_ * SAMPLES),
          corner_attributes_(3 * attribute_channels_),
          fragments_(CHUNK),
          visible_(CHUNK),
          depths_(attribute_channels_ ? CHUNK : 0),
          opacities_(has_ramp(options) ? CHUNK : 0),
          slot_of_step_(CHUNK) {
        // FanFilter::backward takes position gradients in camera space; all others are turned to world space.
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                rotation_[3 * i + j] =
                    scene.filtered ? (float)(i == j) : (float)scene.projection.m[4 * i + j];
    }

    // Replays the tape of a tile and writes its vertex gradients to `out`.
    void backward(int tile_x, int tile_y, const PackedTape &tape, TileGradients &out) {
        area_ = TileArea(grid_, tile_x, tile_y);
        out.count = 0;
        if (!tape.face_count() || !load_image_gradients()) return;
        set_up_triangles(tape.faces(), tape.face_count());
        for (int block = 0; block < BLOCKS; ++block) {
            tape.entries(block, entries_);
            masks_ = tape.masks(block);
            steps_ = tape.steps(block);
            step_count_ = tape.step_count(block);
            if (has_ramp(options_) && attribute_channels_)
                backward_block<true, true>(block);
            else if (has_ramp(options_))
                backward_block<false, true>(block);
            else if (attribute_channels_)
                backward_block<true, false>(block);
            else
                backward_block<false, false>(block);
        }
        write_gradients(tape.face_count(), out);
    }

  private:
    // Steps that are replayed together. Bounds the memory of a block with many steps.
    static constexpr int64_t CHUNK = 1024;

    // A triangle of the tape. Coordinates are relative to a per-triangle origin near the triangle and the
    // tile, against cancellation. Groups of four floats are written by store_transposed.
    struct TapeTriangle {
        alignas(64) float a[4], b[4], c[4], low[4], high[4],
            first[4];                  // RGBA / depth; range and first corner of RGBA
        float qa, qb, qc, q_min;       // 1 / depth
        float q_max, x0, y0, padding;  // origin, relative to the tile
    };
    // sum[c]: sums of z g times 1, x and y, g the gradient of channel c of RGBA; last column: those of z g v,
    // over all channels c where v is the value relative to the first corner.
    struct Moments {
        alignas(64) float sum[4][4];
    };
    // The corners of LANES triangles.
    struct Corners {
        Lanes s[3][3];             // by corner: a, b, c of s_k: the matrix A
        Lanes corner_delta[2][4];  // RGBA of the other corners relative to the first
        int32_t vertex[3][LANES];
    };
    // The fragments of an entry.
    struct EntryFragments {
        Lanes rgba[4];   // undefined in lanes without a fragment
        Lanes z_weight;  // depth z; replay_forward multiplies it by the transmittance T
        Lanes d_alpha;   // c . g, summed over the channels; propagate_behind subtracts B . g
    };
    // Of an entry with a ramp (see ramp.h): the interpolated opacity a and da'/da. Its RGBA has a'.
    struct EntryOpacities {
        Lanes interpolated, slope;
    };
    // The entry in a slot, and its lanes with fragments that early termination kept.
    struct VisibleEntry {
        uint32_t entry;
        LaneMask lanes;
    };
    // A vertex attribute on a triangle: value / depth = a x + b y + c; range and first corner of the value.
    struct AttributePlane {
        float a, b, c, low, high, first;
    };

    // Fills the gradients of the samples; false if all are 0.
    bool load_image_gradients() {
        const int s = grid_.samples;
        const float share = 1.0f / (s * s);
        bool any = false;
        for (int c = 0; c < 3; ++c) std::fill(grad_color_[c], grad_color_[c] + SAMPLES, 0.0f);
        for (int c = 0; c < 3; ++c) std::fill(target_[c], target_[c] + SAMPLES, 0.0f);
        std::fill(expected_weight_, expected_weight_ + SAMPLES, 0.0f);
        std::fill(background_behind_, background_behind_ + SAMPLES, 0.0f);
        std::fill(grad_attributes_.begin(), grad_attributes_.end(), 0.0f);
        for (int y = 0; y < area_.rows; ++y) {
            for (int x = 0; x < area_.columns; ++x) {
                const int sample = TileArea::sample_index(x, y);
                const int64_t pixel = (int64_t)((area_.y0 + y) / s) * camera_.width + (area_.x0 + x) / s;
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                // Alpha is 1 - T_end: a colour channel that is 0 everywhere over a background of -1.
                float behind = image_gradients_.alpha ? -image_gradients_.alpha[pixel] * share : 0;
                any |= behind != 0;
                for (int c = 0; c < 3; ++c) {
                    const float g = image_gradients_.color[3 * pixel + c] * share;
                    grad_color_[c][sample] = g;
                    behind += g * background[c];
                    any |= g != 0;
                }
                const float expected =
                    image_gradients_.expected_weight ? image_gradients_.expected_weight[pixel] * share : 0;
                expected_weight_[sample] = expected;
                for (int c = 0; c < 3 && expected != 0; ++c) {
                    target_[c][sample] = image_gradients_.target[3 * pixel + c];
                    const float error = background[c] - target_[c][sample];
                    behind += expected * error * error;
                    any = true;
                }
                for (int c = 0; c < attribute_channels_; ++c) {
                    const float g = image_gradients_.attributes[pixel * attribute_channels_ + c] * share;
                    grad_attributes_[(size_t)c * SAMPLES + sample] = g;
                    any |= g != 0;
                }
                background_behind_[sample] = behind;
            }
        }
        return any;
    }

    // Triangle set-up for the faces of the tape, LANES at a time.
    void set_up_triangles(const int32_t *faces, size_t n) {
        const size_t batches = (n + LANES - 1) / LANES;
        if (corners_.size() < batches) {
            triangles_.resize(batches * LANES);
            moments_.resize(batches * LANES);
            corners_.resize(batches);
        }
        attribute_planes_.resize(n * attribute_channels_);
        attribute_moments_.assign(n * attribute_channels_ * 3, 0.0f);
        for (size_t i = 0; i < std::min(n, CORNERS_AHEAD); ++i) prefetch_corners(faces[i]);
        for (size_t begin = 0; begin < n; begin += LANES) set_up_batch(faces, n, begin);
    }

    static constexpr size_t FACES_AHEAD = 2 * LANES, CORNERS_AHEAD = LANES;  // prefetch distances

    __attribute__((always_inline)) void prefetch_corners(int64_t face) {
        for (int k = 0; k < 3; ++k) {
            const int64_t corner = mesh_.faces[3 * face + k];
            __builtin_prefetch(&scene_.vertices[corner]);
            __builtin_prefetch(mesh_.colors + 4 * corner);
        }
    }

    // Fills triangles_, corners_ and moments_ of the triangles [begin, begin + LANES).
    void set_up_batch(const int32_t *faces, size_t n, size_t begin) {
        const int size = (int)std::min<size_t>(LANES, n - begin);
        for (size_t i = begin; i < begin + size; ++i) {
            if (i + FACES_AHEAD < n) __builtin_prefetch(mesh_.faces + 3 * (int64_t)faces[i + FACES_AHEAD]);
            if (i + CORNERS_AHEAD < n) prefetch_corners(faces[i + CORNERS_AHEAD]);
        }
        TriangleSetup<LANES> &t = batch_;
        Corners &corners = corners_[begin / LANES];
        set_up_geometry(&faces[begin], size, corners.vertex);
        for (int i = 0; i < 3; ++i) {
            corners.s[i][0] = load_lanes(t.sa[i]);
            corners.s[i][1] = load_lanes(t.sb[i]);
            corners.s[i][2] = load_lanes(t.sc[i]);
        }
        Lanes rgba[3][4];
        for (int i = 0; i < 3; ++i)
            load_transposed([&](int k) { return t.rgba[i][k < size ? k : 0]; }, rgba[i]);
        for (int j = 0; j < 2; ++j)
            for (int c = 0; c < 4; ++c) corners.corner_delta[j][c] = rgba[j + 1][c] - rgba[0][c];
        store_triangles(corners, rgba, &triangles_[begin]);
        std::fill(&moments_[begin], &moments_[begin] + size, Moments{});
        for (int k = 0; k < size; ++k)
            for (int c = 0; c < attribute_channels_; ++c)
                attribute_planes_[(begin + k) * attribute_channels_ + c] = attribute_plane(corners, k, c);
    }

    // Writes LANES triangles from their corners and batch_.
    void store_triangles(const Corners &corners, const Lanes rgba[3][4], TapeTriangle *first) {
        const TriangleSetup<LANES> &t = batch_;
        auto store_rgba = [&](const Lanes columns[4], float (TapeTriangle::*row)[4]) {
            store_transposed(columns[0], columns[1], columns[2], columns[3],
                             [&](int k) { return first[k].*row; });
        };
        Lanes mixed[4];
        // Coefficient j of RGBA / depth.
        auto interpolate = [&](int j) {
            for (int c = 0; c < 4; ++c)
                mixed[c] = mul_add(corners.s[0][j], rgba[0][c],
                                   mul_add(corners.s[1][j], rgba[1][c], corners.s[2][j] * rgba[2][c]));
            return mixed;
        };
        store_rgba(interpolate(0), &TapeTriangle::a);
        store_rgba(interpolate(1), &TapeTriangle::b);
        store_rgba(interpolate(2), &TapeTriangle::c);
        store_rgba(rgba[0], &TapeTriangle::first);
        for (int c = 0; c < 4; ++c) mixed[c] = min_lanes(min_lanes(rgba[0][c], rgba[1][c]), rgba[2][c]);
        store_rgba(mixed, &TapeTriangle::low);
        for (int c = 0; c < 4; ++c) mixed[c] = max_lanes(max_lanes(rgba[0][c], rgba[1][c]), rgba[2][c]);
        store_rgba(mixed, &TapeTriangle::high);
        store_transposed(load_lanes(t.qa), load_lanes(t.qb), load_lanes(t.qc), load_lanes(t.q_min),
                         [&](int k) { return &first[k].qa; });
        store_transposed(load_lanes(t.q_max), load_lanes(origin_x_), load_lanes(origin_y_), broadcast(0),
                         [&](int k) { return &first[k].q_max; });
    }

    AttributePlane attribute_plane(const Corners &corners, int k, int channel) const {
        const TriangleSetup<LANES> &t = batch_;
        AttributePlane plane{0, 0, 0, 0, 0, 0};
        for (int i = 0; i < 3; ++i) {
            const float v = mesh_.attributes[(int64_t)corners.vertex[i][k] * attribute_channels_ + channel];
            plane.a += t.sa[i][k] * v;
            plane.b += t.sb[i][k] * v;
            plane.c += t.sc[i][k] * v;
            plane.low = i ? std::min(plane.low, v) : v;
            plane.high = i ? std::max(plane.high, v) : v;
            if (i == 0) plane.first = v;
        }
        return plane;
    }

    // Sets up batch_ for `size` faces, each relative to its own origin.
    void set_up_geometry(const int32_t *faces, int size, int32_t vertex[3][LANES]) {
        TriangleSetup<LANES> &t = batch_;
        for (int k = 0; k < size; ++k) {
            MS_ASSERT(faces[k] >= 0 && faces[k] < mesh_.face_count);
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
        choose_origins(t.x, size, origin_x_);
        choose_origins(t.y, size, origin_y_);
        t.set_up_visible();
        for (int k = 0; k < size; ++k) {
            if (!t.is_clipped(k)) continue;
            Vec3 v[3];
            scene_.homogeneous_corners(mesh_.faces + 3 * (int64_t)faces[k], area_.x0 + origin_x_[k],
                                       area_.y0 + origin_y_[k], v);
            t.set_up_clipped(k, v, scene_.projection.near);
        }
    }

    // Makes one coordinate of batch_ relative to the mean of the visible corners, clamped to the tile.
    // Rounded to an integer, so that the distances of samples from it are exact.
    void choose_origins(double p[3][LANES], int size, float *origin) {
        const TriangleSetup<LANES> &t = batch_;
        for (int k = 0; k < size; ++k) {
            double sum = 0, count = 0;
            for (int i = 0; i < 3; ++i) {
                sum += t.w[i][k] > 0 ? p[i][k] : 0;
                count += t.w[i][k] > 0 ? 1 : 0;
            }
            const double mean = sum / (count > 0 ? count : 1);
            origin[k] = (float)(int)(mean > 0 ? (mean < TILE ? mean : TILE) : 0);
            for (int i = 0; i < 3; ++i) p[i][k] -= origin[k];
        }
    }

    // The samples of a block relative to the tile.
    struct BlockSamples {
        int block;
        Lanes x, y;

        explicit BlockSamples(int block)
            : block(block),
              x(TileArea::samples_x() + broadcast(TileArea::block_x(block))),
              y(TileArea::samples_y() + broadcast(TileArea::block_y(block))) {}
    };
    const float *grad_color(int c, int block) const { return grad_color_[c] + block * LANES; }
    const float *grad_attribute(int c, int block) const {
        return &grad_attributes_[(size_t)c * SAMPLES + block * LANES];
    }

    // Adds the fragments of a block to the moments of their triangles, in three passes over each chunk of
    // steps: replay_forward finds T from the front, propagate_behind B from the back, and add_moments takes
    // entries as a whole. Chunks are processed from back to front, so a first sweep over all chunks finds T
    // where each begins.
    template <bool ATTRIBUTES, bool RAMP>
    void backward_block(int block) {
        const BlockSamples samples(block);
        const int64_t chunks = (step_count_ + CHUNK - 1) / CHUNK;
        slot_of_entry_.assign(entries_.size(), 0);
        first_slot_ = 1;
        slot_count_ = 0;
        chunk_transmittance_.resize(chunks + 1);
        chunk_transmittance_[0] = broadcast(1);
        for (int64_t chunk = 0; chunk < chunks; ++chunk)
            chunk_transmittance_[chunk + 1] =
                replay_forward<ATTRIBUTES, RAMP>(samples, chunk, chunk_transmittance_[chunk]);
        Lanes behind = load_lanes(background_behind_ + block * LANES);
        for (int64_t chunk = chunks - 1; chunk >= 0; --chunk) {
            // The sweep ended with the last chunk: its fragments are still there.
            if (chunk < chunks - 1)
                replay_forward<ATTRIBUTES, RAMP>(samples, chunk, chunk_transmittance_[chunk]);
            behind = propagate_behind(chunk, behind);
            for (uint32_t slot = 0; slot < slot_count_; ++slot) add_moments<ATTRIBUTES, RAMP>(samples, slot);
        }
    }

    const PackedTape::IndexedLanes *chunk_steps(int64_t chunk) const { return steps_ + chunk * CHUNK; }
    int64_t chunk_size(int64_t chunk) const {
        return std::min(step_count_, (chunk + 1) * CHUNK) - chunk * CHUNK;
    }

    // Evaluates the entries of a chunk and multiplies their weights by the transmittance in front of them.
    // Takes the transmittance in front of the chunk and returns that behind it.
    template <bool ATTRIBUTES, bool RAMP>
    Lanes replay_forward(const BlockSamples &samples, int64_t chunk, Lanes transmittance) {
        const Lanes limit = broadcast(options_.min_transmittance);
        const PackedTape::IndexedLanes *steps = chunk_steps(chunk);
        const int64_t n = chunk_size(chunk);
        assign_slots(steps, n);
        for (uint32_t slot = 0; slot < slot_count_; ++slot) {
            const Lanes z = evaluate<ATTRIBUTES, RAMP>(samples, entries_[visible_[slot].entry], slot);
            if (ATTRIBUTES) depths_[slot] = z;
        }
        for (int64_t i = 0; i < n; ++i) {
            const LaneMask lanes = steps[i].lanes;
            EntryFragments &f = fragments_[slot_of_step_[i]];
            f.z_weight = select(lanes, transmittance * f.z_weight, f.z_weight);
            visible_[slot_of_step_[i]].lanes |= lanes & greater_equal(transmittance, limit);
            transmittance = transmittance - masked(lanes, transmittance * f.rgba[3]);
        }
        return transmittance;
    }

    // Gives the entries of n steps slots [0, slot_count_), in the order of their first steps. slot_of_entry_
    // holds first_slot_ + slot, and first_slot_ grows beyond all earlier values: smaller ones are of earlier
    // chunks.
    __attribute__((always_inline)) void assign_slots(const PackedTape::IndexedLanes *steps, int64_t n) {
        const uint32_t first = first_slot_ + slot_count_;
        uint32_t count = 0;
        for (int64_t i = 0; i < n; ++i) {
            MS_ASSERT(steps[i].index() < entries_.size());
            // Branch-free: new entries are unpredictable.
            uint32_t &slot = slot_of_entry_[steps[i].index()];
            visible_[count] = {steps[i].index(), 0};
            const bool is_new = slot < first;
            slot = is_new ? first + count : slot;
            slot_of_step_[i] = (uint16_t)(slot - first);
            count += is_new;
        }
        first_slot_ = first;
        slot_count_ = count;
    }

    // Subtracts B . g from d_alpha. Takes B . g behind the chunk and returns that in front of it.
    __attribute__((always_inline)) Lanes propagate_behind(int64_t chunk, Lanes behind) {
        const PackedTape::IndexedLanes *steps = chunk_steps(chunk);
        for (int64_t i = chunk_size(chunk); i-- > 0;) {
            EntryFragments &f = fragments_[slot_of_step_[i]];
            const Lanes d_alpha = f.d_alpha - behind;
            f.d_alpha = select(steps[i].lanes, d_alpha, f.d_alpha);
            behind = behind + masked(steps[i].lanes, f.rgba[3] * d_alpha);
        }
        return behind;
    }

    // Interpolates an entry, without regard to what lies in front and behind; returns the depth.
    template <bool ATTRIBUTES, bool RAMP>
    __attribute__((always_inline)) Lanes evaluate(const BlockSamples &samples, const TapeEntry entry,
                                                  uint32_t slot) {
        EntryFragments &f = fragments_[slot];
        MS_ASSERT(entry.mask_count >= 1);
        const PackedTape::IndexedLanes *mask = masks_ + entry.first_mask;
        Lanes q, linear[4];  // 1 / depth, RGBA / depth
        const TapeTriangle *t = &triangles_[mask->index()];
        f4 low = load4(t->low), high = load4(t->high);
        float q_min = t->q_min, q_max = t->q_max;
        for (uint32_t i = 0;;) {
            const Lanes x = samples.x - broadcast(t->x0), y = samples.y - broadcast(t->y0);
            const Lanes own_q = mul_add(broadcast(t->qa), x, mul_add(broadcast(t->qb), y, broadcast(t->qc)));
            q = i ? select(mask[i].lanes, own_q, q) : own_q;
            for (int c = 0; c < 4; ++c) {
                const Lanes value =
                    mul_add(broadcast(t->a[c]), x, mul_add(broadcast(t->b[c]), y, broadcast(t->c[c])));
                linear[c] = i ? select(mask[i].lanes, value, linear[c]) : value;
            }
            if (++i == entry.mask_count) break;
            t = &triangles_[mask[i].index()];
            low = min4(low, load4(t->low));
            high = max4(high, load4(t->high));
            q_min = std::min(q_min, t->q_min);
            q_max = std::max(q_max, t->q_max);
        }
        const Lanes z = f.z_weight = reciprocal(clamp(q, broadcast(q_min), broadcast(q_max)));
        for (int c = 0; c < 4; ++c) f.rgba[c] = clamp(linear[c] * z, broadcast(low[c]), broadcast(high[c]));
        const int block = samples.block;
        if (RAMP) evaluate_ramp(entry, z, slot);
        f.d_alpha = mul_add(f.rgba[0], load_lanes(grad_color(0, block)),
                            mul_add(f.rgba[1], load_lanes(grad_color(1, block)),
                                    f.rgba[2] * load_lanes(grad_color(2, block))));
        if (image_gradients_.expected_weight) {
            Lanes square = broadcast(0);
            for (int c = 0; c < 3; ++c) {
                const Lanes error = target_error(f, c, block);
                square = mul_add(error, error, square);
            }
            f.d_alpha = mul_add(square, load_lanes(expected_weight_ + block * LANES), f.d_alpha);
        }
        if (!ATTRIBUTES) return z;
        for (uint32_t i = 0; i < entry.mask_count; ++i) {
            t = &triangles_[mask[i].index()];
            const Lanes x = samples.x - broadcast(t->x0), y = samples.y - broadcast(t->y0);
            for (int c = 0; c < attribute_channels_; ++c)
                f.d_alpha = f.d_alpha + masked(mask[i].lanes, attribute_value(mask[i].index(), c, x, y, z) *
                                                                  load_lanes(grad_attribute(c, block)));
        }
        return z;
    }

    // c - target of one colour channel.
    Lanes target_error(const EntryFragments &f, int c, int block) const {
        return f.rgba[c] - load_lanes(target_[c] + block * LANES);
    }

    // Replaces the opacity of the entry in a slot by that of the ramp. z is its depth.
    void evaluate_ramp(const TapeEntry entry, const Lanes &z, uint32_t slot) {
        Lanes &alpha = fragments_[slot].rgba[3];
        const PackedTape::IndexedLanes *mask = masks_ + entry.first_mask;
        Lanes a, b, qa, qb;
        for (uint32_t i = 0; i < entry.mask_count; ++i) {
            const TapeTriangle &t = triangles_[mask[i].index()];
            const LaneMask lanes = mask[i].lanes;
            a = i ? select(lanes, broadcast(t.a[3]), a) : broadcast(t.a[3]);
            b = i ? select(lanes, broadcast(t.b[3]), b) : broadcast(t.b[3]);
            qa = i ? select(lanes, broadcast(t.qa), qa) : broadcast(t.qa);
            qb = i ? select(lanes, broadcast(t.qb), qb) : broadcast(t.qb);
        }
        const Ramp ramp = opacity_ramp(options_, alpha, (a - alpha * qa) * z, (b - alpha * qb) * z);
        opacities_[slot] = {alpha, ramp.slope};
        alpha = ramp.opacity;
    }

    // Adds the entry in a slot to the moments of its triangles.
    template <bool ATTRIBUTES, bool RAMP>
    __attribute__((always_inline)) void add_moments(const BlockSamples &samples, uint32_t slot) {
        const EntryFragments &f = fragments_[slot];
        const VisibleEntry visible = visible_[slot];
        const TapeEntry entry = entries_[visible.entry];
        const int block = samples.block;
        // z T, z T a, and z times the gradients of RGBA.
        const Lanes weight = masked(visible.lanes, f.z_weight), color_weight = weight * f.rgba[3];
        Lanes grad[4] = {color_weight * load_lanes(grad_color(0, block)),
                         color_weight * load_lanes(grad_color(1, block)),
                         color_weight * load_lanes(grad_color(2, block)), weight * f.d_alpha};
        if (image_gradients_.expected_weight) {
            const Lanes twice = color_weight * load_lanes(expected_weight_ + block * LANES) * broadcast(2);
            for (int c = 0; c < 3; ++c) grad[c] = mul_add(twice, target_error(f, c, block), grad[c]);
        }
        if (RAMP) grad[3] = grad[3] * opacities_[slot].slope;
        const Lanes &alpha = RAMP ? opacities_[slot].interpolated : f.rgba[3];
        for (uint32_t i = entry.first_mask; i < entry.first_mask + entry.mask_count; ++i) {
            const PackedTape::IndexedLanes mask = masks_[i];
            const uint32_t triangle = mask.index();
            const TapeTriangle &t = triangles_[triangle];
            const Lanes x = samples.x - broadcast(t.x0), y = samples.y - broadcast(t.y0);
            Lanes sums[4], sums_y[4];
            for (int c = 0; c < 4; ++c) sums[c] = masked(mask.lanes, grad[c]);
            Lanes v = sums[0] * (f.rgba[0] - broadcast(t.first[0]));
            for (int c = 1; c < 4; ++c)
                v = mul_add(sums[c], (c == 3 ? alpha : f.rgba[c]) - broadcast(t.first[c]), v);
            if (ATTRIBUTES) {
                for (int c = 0; c < attribute_channels_; ++c) {
                    const size_t plane = (size_t)triangle * attribute_channels_ + c;
                    const Lanes g = masked(mask.lanes, color_weight * load_lanes(grad_attribute(c, block)));
                    v = v + g * (attribute_value(triangle, c, x, y, depths_[slot]) -
                                 broadcast(attribute_planes_[plane].first));
                    float *to = &attribute_moments_[plane * 3];
                    to[0] += sum(g * x);
                    to[1] += sum(g * y);
                    to[2] += sum(g);
                }
            }
            for (int c = 0; c < 4; ++c) sums_y[c] = sums[c] * y;
            const Lanes sums_v[4] = {v, v * x, v * y, broadcast(0)};
            // x is the same in every row of the block, so the column sums times x replace a fourth sum_rows.
            Lanes columns[4] = {sum_rows(sums), broadcast(0), sum_rows(sums_y), sum_rows(sums_v)};
            columns[1] = columns[0] * x;
            float *to = moments_[triangle].sum[0];
            store_lanes(to, load_lanes(to) + sum_columns(columns));
        }
    }

    Lanes attribute_value(uint32_t triangle, int c, const Lanes &x, const Lanes &y, const Lanes &z) const {
        const AttributePlane &p = attribute_planes_[(size_t)triangle * attribute_channels_ + c];
        return clamp(((broadcast(p.a) * x + broadcast(p.b) * y) + broadcast(p.c)) * z, broadcast(p.low),
                     broadcast(p.high));
    }

    // From the moments of `count` triangles to the gradients of their vertices.
    void write_gradients(size_t count, TileGradients &out) {
        // A fan of n triangles has about n vertices, other meshes more: then `out` grows.
        out.reserve(count + count / 2, attribute_channels_);
        for (size_t begin = 0; begin < count; begin += LANES)
            write_batch(begin, (int)std::min<size_t>(LANES, count - begin), out);
    }

    // The gradients of `size` triangles from `begin` on: dL/dv_k and dL/dV of the header.
    void write_batch(size_t begin, int size, TileGradients &out) {
        const Corners &corners = corners_[begin / LANES];
        const auto &s = corners.s;
        Lanes moments[4][4];
        for (int c = 0; c < 4; ++c)
            load_transposed([&](int i) { return moments_[begin + i].sum[c]; }, moments[c]);
        // Moments are in the order 1, x, y; from here on it is that of p: x, y, 1.
        Lanes of_rgba[4][3], g[3][3];
        for (int c = 0; c < 4; ++c)
            for (int j = 0; j < 3; ++j) of_rgba[c][j] = moments[c][(j + 1) % 3];
        // G, one row per corner, from v_k and v relative to the first corner.
        for (int j = 0; j < 3; ++j) {
            g[0][j] = broadcast(0) - moments[(j + 1) % 3][3];
            for (int k = 1; k < 3; ++k) {
                g[k][j] = g[0][j];
                for (int c = 0; c < 4; ++c)
                    g[k][j] = mul_add(corners.corner_delta[k - 1][c], of_rgba[c][j], g[k][j]);
            }
        }
        for (int c = 0; c < attribute_channels_; ++c) add_attribute(corners, begin, size, c, g);
        const Projection &pr = scene_.projection;
        alignas(64) float to_x[LANES], to_y[LANES];  // from the triangle's origin to the principal point
        for (int i = 0; i < LANES; ++i) {
            const TapeTriangle &t = triangles_[begin + std::min(i, size - 1)];
            to_x[i] = (float)(pr.cx - area_.x0 - t.x0);
            to_y[i] = (float)(pr.cy - area_.y0 - t.y0);
        }
        TileGradients::Sum sums[3][LANES];
        for (int k = 0; k < 3; ++k) {
            store_transposed(dot(s[k], of_rgba[0]), dot(s[k], of_rgba[1]), dot(s[k], of_rgba[2]),
                             dot(s[k], of_rgba[3]), [&](int i) { return sums[k][i].rgba; });
            // Row k of dL/dV, then by way of the camera's focal lengths and principal point to camera space.
            Lanes d[3] = {broadcast(0), broadcast(0), broadcast(0)};
            for (int i = 0; i < 3; ++i) {
                const Lanes h = dot(g[i], s[k]);
                for (int j = 0; j < 3; ++j) d[j] = d[j] - s[i][j] * h;
            }
            const Lanes z = mul_add(load_lanes(to_x), d[0], mul_add(load_lanes(to_y), d[1], d[2]));
            const Lanes x = d[0] * broadcast((float)pr.fx), y = d[1] * broadcast((float)pr.fy);
            Lanes position[3];
            for (int j = 0; j < 3; ++j)
                position[j] =
                    mul_add(broadcast(rotation_[j]), x,
                            mul_add(broadcast(rotation_[3 + j]), y, broadcast(rotation_[6 + j]) * z));
            store_transposed(position[0], position[1], position[2], broadcast(0),
                             [&](int i) { return sums[k][i].position; });
        }
        out.reserve(3 * LANES, attribute_channels_);
        for (int i = 0; i < size; ++i)
            for (int k = 0; k < 3; ++k) add_corner(corners.vertex[k][i], sums[k][i], k, i, out);
    }

    // Sets the gradients of one attribute at the corners, and adds its part to G.
    void add_attribute(const Corners &corners, size_t begin, int size, int c, Lanes g[3][3]) {
        const int channels = attribute_channels_;
        Lanes sums[3];
        for (int j = 0; j < 3; ++j) {
            alignas(64) float column[LANES] = {};
            for (int i = 0; i < size; ++i)
                column[i] = attribute_moments_[((begin + i) * channels + c) * 3 + j];
            sums[j] = load_lanes(column);
        }
        for (int k = 0; k < 3; ++k) {
            corner_attributes_[k * channels + c] = dot(corners.s[k], sums);
            alignas(64) float delta[LANES] = {};
            for (int i = 0; i < size; ++i)
                delta[i] = mesh_.attributes[(int64_t)corners.vertex[k][i] * channels + c] -
                           attribute_planes_[(begin + i) * channels + c].first;
            for (int j = 0; j < 3; ++j) g[k][j] = mul_add(load_lanes(delta), sums[j], g[k][j]);
        }
    }

    // Adds the gradient of a corner to that of its vertex. The triangles of a fan follow each other, so a
    // small hash table without chaining finds most vertices again; others get another element.
    void add_corner(int32_t vertex, const TileGradients::Sum &sum, int corner, int lane, TileGradients &out) {
        MS_ASSERT(vertex >= 0 && vertex < mesh_.vertex_count && out.count < out.vertices.size());
        uint32_t &cached = cached_index_[(uint32_t)vertex % CACHE_SIZE];
        // Branch-free: hits are unpredictable. Uninitialised elements are masked to 0.
        const uint32_t candidate = cached < out.count ? cached : 0, end = (uint32_t)out.count;
        const bool hit = (cached < out.count) & (out.vertices[candidate] == vertex);
        const uint32_t index = cached = hit ? candidate : end;
        out.count += !hit;
        out.vertices[index] = vertex;
        TileGradients::Sum &to = out.sums[index];
        store4(to.position, masked4(hit, load4(to.position)) + load4(sum.position));
        store4(to.rgba, masked4(hit, load4(to.rgba)) + load4(sum.rgba));
        for (int c = 0; c < attribute_channels_; ++c) {
            float &attribute = out.attributes[(size_t)index * attribute_channels_ + c];
            attribute =
                (hit ? attribute : 0) + lane_of(corner_attributes_[corner * attribute_channels_ + c], lane);
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
    const MsImageGradients &image_gradients_;
    const int attribute_channels_;
    float rotation_[9];  // 3 x 3, from the space of the position gradients to camera space

    // Of the tile.
    TileArea area_;
    alignas(64) float grad_color_[3][SAMPLES];      // gradients g of the colour of each sample
    alignas(64) float background_behind_[SAMPLES];  // B . g at the end
    alignas(64) float target_[3][SAMPLES];          // of the expected loss
    alignas(64) float expected_weight_[SAMPLES];    // likewise, 0 without one
    std::vector<float> grad_attributes_;            // (channel, sample)
    TriangleSetup<LANES> batch_;
    float origin_x_[LANES], origin_y_[LANES];       // of the triangles of batch_, relative to the tile
    std::vector<TapeTriangle> triangles_;           // by index on the tape
    std::vector<Moments> moments_;                  // likewise
    std::vector<Corners> corners_;                  // of LANES triangles each
    std::vector<AttributePlane> attribute_planes_;  // (triangle, channel)
    std::vector<float> attribute_moments_;          // (triangle, channel, 3): x, y, 1
    std::vector<Lanes> corner_attributes_;          // (corner, channel) of LANES triangles

    // Of the block.
    std::vector<TapeEntry> entries_;
    const PackedTape::IndexedLanes *masks_, *steps_;
    int64_t step_count_;
    std::vector<uint32_t> slot_of_entry_;     // see assign_slots
    std::vector<Lanes> chunk_transmittance_;  // in front of each chunk

    // Of the chunk: by slot, but for slot_of_step_.
    uint32_t first_slot_, slot_count_;
    std::vector<EntryFragments> fragments_;
    std::vector<VisibleEntry> visible_;
    std::vector<Lanes> depths_;              // if there are attributes
    std::vector<EntryOpacities> opacities_;  // if there is a ramp
    std::vector<uint16_t> slot_of_step_;

    static constexpr uint32_t CACHE_SIZE = 2048;
    uint32_t cached_index_[CACHE_SIZE] = {};  // by hash: where in TileGradients the vertex may be
};

// Adds the gradients of tiles to those of the vertices, in the order of the tiles: the result does not depend
// on the number of threads.
class VertexGradients {
  public:
    VertexGradients(const MsMesh &mesh, const MsVertexGradients &out, int attribute_channels, int threads)
        : mesh_(mesh), out_(out), attribute_channels_(attribute_channels), threads_(threads) {}

    // Each thread goes through all tiles and adds its own range of vertices.
    void add(const TileGradients *tiles, int count) {
        on_threads(threads_, [&](int thread) {
            const int64_t begin = mesh_.vertex_count * thread / threads_,
                          end = mesh_.vertex_count * (thread + 1) / threads_;
            for (int i = 0; i < count; ++i) add_tile(tiles[i], begin, end);
        });
    }

  private:
    static constexpr size_t PREFETCH_AHEAD = 24;

    void add_tile(const TileGradients &tile, int64_t begin, int64_t end) {
        for (size_t i = 0; i < tile.count; ++i) {
            if (i + PREFETCH_AHEAD < tile.count) {
                const int64_t v = tile.vertices[i + PREFETCH_AHEAD];
                __builtin_prefetch(out_.vertices + 3 * v, 1);
                __builtin_prefetch(out_.colors + 4 * v, 1);
            }
            const int64_t v = tile.vertices[i];
            if (v < begin || v >= end) continue;
            const TileGradients::Sum &sum = tile.sums[i];
            for (int j = 0; j < 3; ++j) out_.vertices[3 * v + j] += sum.position[j];
            store4(out_.colors + 4 * v, load4(out_.colors + 4 * v) + load4(sum.rgba));
            for (int c = 0; c < attribute_channels_; ++c)
                out_.attributes[v * attribute_channels_ + c] += tile.attributes[i * attribute_channels_ + c];
        }
    }

    const MsMesh &mesh_;
    const MsVertexGradients &out_;
    int attribute_channels_, threads_;
};

}  // namespace ms
