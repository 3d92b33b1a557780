// Backward pass: from image gradients to vertex gradients.
//
// With B_k, the radiance behind fragment k, B_k = a_{k+1} c_{k+1} + (1 - a_{k+1}) B_{k+1} and B = background
// at the end,
//     dC/dc_k = T_k a_k,  dC/da_k = T_k (c_k - B_k).
// B is found from back to front, so that nothing is divided by 1 - a and a = 1 needs no exception.
// The triangles that a sample sees and their order are constants. For the gradients of vertices see
// tape_triangles.h.
#pragma once

#include "ramp.h"
#include "sample_gradients.h"
#include "tape.h"
#include "tape_triangles.h"

namespace ms {

class GradientTile {
  public:
    GradientTile(const Scene &scene, const MsOptions &options, const MsCamera &camera,
                 const MsImageGradients &image_gradients)
        : mesh_(scene.mesh),
          grid_(scene.grid),
          options_(options),
          attribute_channels_(image_gradients.attributes ? mesh_.attribute_count : 0),
          gradients_(grid_, options, camera, image_gradients, attribute_channels_),
          triangles_(scene, attribute_channels_),
          fragments_(CHUNK),
          visible_(CHUNK),
          recorded_(CHUNK),
          depths_(attribute_channels_ ? CHUNK : 0),
          opacities_(has_ramp(options) ? CHUNK : 0),
          slot_of_step_(CHUNK) {}

    // Replays the tape of a tile and writes its vertex gradients to `out`.
    void backward(int tile_x, int tile_y, const PackedTape &tape, TileGradients &out) {
        const TileArea area(grid_, tile_x, tile_y);
        out.count = 0;
        if (!tape.face_count() || !gradients_.load(area)) return;
        triangles_.set_up(area, tape.faces(), tape.face_count());
        for (int block = 0; block < area.blocks; ++block) {
            tape.entries(block, entries_);
            masks_ = tape.masks(block);
            if (mesh_.by_splat) {
                if (attribute_channels_)
                    backward_block_by_splat<true>(block);
                else
                    backward_block_by_splat<false>(block);
                continue;
            }
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
        triangles_.write_gradients(out);
    }

  private:
    // Steps that are replayed together. Bounds the memory of a block with many steps.
    static constexpr int64_t CHUNK = 1024;

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

    // The samples of a block relative to the tile.
    struct BlockSamples {
        int block;
        Lanes x, y;

        explicit BlockSamples(int block)
            : block(block),
              x(TileArea::samples_x() + broadcast(TileArea::block_x(block))),
              y(TileArea::samples_y() + broadcast(TileArea::block_y(block))) {}
    };

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
        Lanes behind = gradients_.background_behind(block);
        for (int64_t chunk = chunks - 1; chunk >= 0; --chunk) {
            // The sweep ended with the last chunk: its fragments are still there.
            if (chunk < chunks - 1)
                replay_forward<ATTRIBUTES, RAMP>(samples, chunk, chunk_transmittance_[chunk]);
            behind = propagate_behind(chunk, behind);
            for (uint32_t slot = 0; slot < slot_count_; ++slot) add_moments<ATTRIBUTES, RAMP>(samples, slot);
        }
    }

    // Likewise in the order of the splats, where each entry is one step. A sweep from the front and one from
    // the back over each chunk do everything.
    template <bool ATTRIBUTES>
    void backward_block_by_splat(int block) {
        const BlockSamples samples(block);
        const size_t chunks = (entries_.size() + CHUNK - 1) / CHUNK;
        chunk_transmittance_.resize(chunks + 1);
        chunk_transmittance_[0] = broadcast(1);
        for (size_t chunk = 0; chunk < chunks; ++chunk)
            chunk_transmittance_[chunk + 1] =
                sweep_forward<ATTRIBUTES>(samples, chunk * CHUNK, chunk_transmittance_[chunk]);
        Lanes behind = gradients_.background_behind(block);
        for (size_t chunk = chunks; chunk-- > 0;) {
            if (chunk + 1 < chunks)
                sweep_forward<ATTRIBUTES>(samples, chunk * CHUNK, chunk_transmittance_[chunk]);
            for (uint32_t slot = slot_count_; slot-- > 0;) {
                EntryFragments &f = fragments_[slot];
                f.d_alpha = f.d_alpha - behind;
                behind = behind + masked(recorded_[slot], f.rgba[3] * f.d_alpha);
                add_moments<ATTRIBUTES, false>(samples, slot);
            }
        }
    }

    // Evaluates the entries of the chunk that begins at entry `first` and multiplies their weights by the
    // transmittance in front of them. Takes the transmittance in front of the chunk and returns that behind
    // it.
    template <bool ATTRIBUTES>
    Lanes sweep_forward(const BlockSamples &samples, size_t first, Lanes transmittance) {
        const Lanes limit = broadcast(options_.min_transmittance);
        slot_count_ = (uint32_t)std::min<size_t>(CHUNK, entries_.size() - first);
        for (uint32_t slot = 0; slot < slot_count_; ++slot) {
            const TapeEntry entry = entries_[first + slot];
            const Lanes z = evaluate<ATTRIBUTES, false>(samples, entry, slot);
            if (ATTRIBUTES) depths_[slot] = z;
            LaneMask lanes = 0;
            for (uint32_t i = 0; i < entry.mask_count; ++i) lanes |= masks_[entry.first_mask + i].lanes;
            EntryFragments &f = fragments_[slot];
            f.z_weight = transmittance * f.z_weight;
            recorded_[slot] = lanes;
            visible_[slot] = {(uint32_t)first + slot, lanes & greater_equal(transmittance, limit)};
            transmittance = transmittance - masked(lanes, transmittance * f.rgba[3]);
        }
        return transmittance;
    }

    const IndexedLanes *chunk_steps(int64_t chunk) const { return steps_ + chunk * CHUNK; }
    int64_t chunk_size(int64_t chunk) const {
        return std::min(step_count_, (chunk + 1) * CHUNK) - chunk * CHUNK;
    }

    // Evaluates the entries of a chunk and multiplies their weights by the transmittance in front of them.
    // Takes the transmittance in front of the chunk and returns that behind it.
    template <bool ATTRIBUTES, bool RAMP>
    Lanes replay_forward(const BlockSamples &samples, int64_t chunk, Lanes transmittance) {
        const Lanes limit = broadcast(options_.min_transmittance);
        const IndexedLanes *steps = chunk_steps(chunk);
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
    __attribute__((always_inline)) void assign_slots(const IndexedLanes *steps, int64_t n) {
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
        const IndexedLanes *steps = chunk_steps(chunk);
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
        const IndexedLanes *mask = masks_ + entry.first_mask;
        Lanes q, linear[4];  // 1 / depth, RGBA / depth
        const TapeTriangles::Triangle *t = &triangles_[mask->index()];
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
        f.d_alpha =
            mul_add(f.rgba[0], gradients_.color(0, block),
                    mul_add(f.rgba[1], gradients_.color(1, block), f.rgba[2] * gradients_.color(2, block)));
        if (gradients_.any_expected()) {
            Lanes square = broadcast(0);
            for (int c = 0; c < 3; ++c) {
                const Lanes error = target_error(f, c, block);
                square = mul_add(error, error, square);
            }
            f.d_alpha = mul_add(square, gradients_.expected_weight(block), f.d_alpha);
        }
        if (!ATTRIBUTES) return z;
        for (uint32_t i = 0; i < entry.mask_count; ++i) {
            t = &triangles_[mask[i].index()];
            const Lanes x = samples.x - broadcast(t->x0), y = samples.y - broadcast(t->y0);
            for (int c = 0; c < attribute_channels_; ++c)
                f.d_alpha = f.d_alpha +
                            masked(mask[i].lanes, triangles_.attribute_value(mask[i].index(), c, x, y, z) *
                                                      gradients_.attribute(c, block));
        }
        return z;
    }

    // c - target of one colour channel.
    Lanes target_error(const EntryFragments &f, int c, int block) const {
        return f.rgba[c] - gradients_.target(c, block);
    }

    // Replaces the opacity of the entry in a slot by that of the ramp. z is its depth.
    void evaluate_ramp(const TapeEntry entry, const Lanes &z, uint32_t slot) {
        Lanes &alpha = fragments_[slot].rgba[3];
        const IndexedLanes *mask = masks_ + entry.first_mask;
        Lanes a, b, qa, qb;
        for (uint32_t i = 0; i < entry.mask_count; ++i) {
            const TapeTriangles::Triangle &t = triangles_[mask[i].index()];
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
        Lanes grad[4] = {color_weight * gradients_.color(0, block), color_weight * gradients_.color(1, block),
                         color_weight * gradients_.color(2, block), weight * f.d_alpha};
        if (gradients_.any_expected()) {
            const Lanes twice = color_weight * gradients_.expected_weight(block) * broadcast(2);
            for (int c = 0; c < 3; ++c) grad[c] = mul_add(twice, target_error(f, c, block), grad[c]);
        }
        if (RAMP) grad[3] = grad[3] * opacities_[slot].slope;
        const Lanes &alpha = RAMP ? opacities_[slot].interpolated : f.rgba[3];
        for (uint32_t i = entry.first_mask; i < entry.first_mask + entry.mask_count; ++i) {
            const IndexedLanes mask = masks_[i];
            const uint32_t triangle = mask.index();
            const TapeTriangles::Triangle &t = triangles_[triangle];
            const Lanes x = samples.x - broadcast(t.x0), y = samples.y - broadcast(t.y0);
            Lanes sums[4], sums_y[4];
            for (int c = 0; c < 4; ++c) sums[c] = masked(mask.lanes, grad[c]);
            Lanes v = sums[0] * (f.rgba[0] - broadcast(t.first[0]));
            for (int c = 1; c < 4; ++c)
                v = mul_add(sums[c], (c == 3 ? alpha : f.rgba[c]) - broadcast(t.first[c]), v);
            if (ATTRIBUTES) {
                for (int c = 0; c < attribute_channels_; ++c) {
                    const Lanes g = masked(mask.lanes, color_weight * gradients_.attribute(c, block));
                    v = v + g * (triangles_.attribute_value(triangle, c, x, y, depths_[slot]) -
                                 broadcast(triangles_.attribute(triangle, c).first));
                    float *to = triangles_.attribute_moments(triangle, c);
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
            float *to = triangles_.moments(triangle).sum[0];
            store_lanes(to, load_lanes(to) + sum_columns(columns));
        }
    }

    const MsMesh &mesh_;
    const Grid &grid_;
    const MsOptions &options_;
    const int attribute_channels_;
    SampleGradients gradients_;
    TapeTriangles triangles_;

    // Of the block.
    std::vector<TapeEntry> entries_;
    const IndexedLanes *masks_, *steps_;
    int64_t step_count_;
    std::vector<uint32_t> slot_of_entry_;     // see assign_slots
    std::vector<Lanes> chunk_transmittance_;  // in front of each chunk

    // Of the chunk: by slot, but for slot_of_step_.
    uint32_t first_slot_, slot_count_;
    std::vector<EntryFragments> fragments_;
    std::vector<VisibleEntry> visible_;
    std::vector<LaneMask> recorded_;         // lanes of the entry on the tape, in the order of the splats
    std::vector<Lanes> depths_;              // if there are attributes
    std::vector<EntryOpacities> opacities_;  // if there is a ramp
    std::vector<uint16_t> slot_of_step_;
};

}  // namespace ms
