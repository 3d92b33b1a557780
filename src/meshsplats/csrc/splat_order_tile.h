// Rasterizes a mesh into one tile with per-splat sorting, or in the order of a file (DrawOrder): blends whole
// groups in the order of the tile list.
//
// The triangles of a group are blended from the last to the first, as if splats were painted far to near,
// each triangle over those before it. Nothing waits: what arrives lies behind everything that is blended.
#pragma once

#include "tile_rasterizer.h"

namespace ms {

class SplatOrderTile : public TileRasterizer<SplatOrderTile, MAX_QUADRANTS> {
  public:
    SplatOrderTile(const Scene &scene, ImageTile image) : TileRasterizer(scene, std::move(image)) {
        MS_ASSERT(scene.mesh.by_splat && !has_cutoff(image_.options()));
    }

    void record_tape() { image_.record_splat_tape(); }

  private:
    friend class TileRasterizer<SplatOrderTile, MAX_QUADRANTS>;
    static constexpr bool LAST_FIRST = true;

    void batch_done(float) {}
    void finish() {}

    void rasterize_group(int begin, int end, unsigned clipped) {
        const bool general = clipped || image_.needs_weights() || image_.options().max_layers;
        if (image_.splat_tape())
            general ? blend_group<true, true>(begin, end, clipped) : blend_group<false, true>(begin, end, 0);
        else
            general ? blend_group<true, false>(begin, end, clipped)
                    : blend_group<false, false>(begin, end, 0);
    }

    // Blends the triangles [begin, end) of the batch. GENERAL: with clipped triangles, extra outputs or a
    // layer limit. TAPED: with a tape.
    template <bool GENERAL, bool TAPED>
    void blend_group(int begin, int end, unsigned clipped) {
        MS_ASSERT(begin < end && end <= batch_size_);
        uint8_t triangles_of[MAX_BLOCKS] = {};  // one bit per triangle of the batch
        static_assert(Batch::N <= 8);
        TileCoverage *coverage = GENERAL ? image_.coverage() : nullptr;
        if (coverage) coverage->reserve(Batch::N, Batch::N * MAX_BLOCKS);
        if (TAPED) image_.splat_tape()->reserve_faces(Batch::N);
        BlockMask blocks = 0;
        float most_opaque = 0;
        for (int k = begin; k < end; ++k) {
            BlockMask touched = set_up_functions(k);
            blocks |= touched;
            if (TAPED && touched) most_opaque = std::max(most_opaque, functions_[k].high[3]);
            if (coverage && touched) coverage_index_[k] = coverage->add_triangle(batch_.face[k]);
            if (TAPED) tape_index_[k] = SplatTape::NO_INDEX;
            for (; touched; touched &= touched - 1) triangles_of[lowest_block(touched)] |= 1u << k;
        }
        for (; blocks; blocks &= blocks - 1) {
            const int block = lowest_block(blocks);
            if (TAPED) image_.expect_opacity(block, most_opaque);
            blend_block<GENERAL, TAPED>(block, triangles_of[block], clipped, coverage);
        }
    }

    // Fragments of triangles that do not overlap, which are evaluated and blended together.
    struct Entry {
        Lanes q, linear[4];  // 1 / depth, RGBA / depth
        f4 low, high;        // range of RGBA
        float q_min, q_max;
        LaneMask covered;
        uint32_t first_mask, mask_count;
        FragmentWeights weights;
    };

    // Blends some triangles of one group into a block.
    template <bool GENERAL, bool TAPED>
    __attribute__((always_inline)) void blend_block(int block, unsigned triangles, unsigned clipped,
                                                    TileCoverage *coverage) {
        const Batch &t = batch_;
        SplatTape *const tape = image_.splat_tape();
        if (TAPED) tape->blocks[block].reserve(Batch::N);
        LaneMask active = image_.active(block);
        Entry entry;
        entry.covered = entry.mask_count = 0;
        entry.first_mask = coverage ? coverage->mask_count : 0;
        for (; triangles; triangles &= triangles - 1) {
            const int k = __builtin_ctz(triangles);
            const BlockFunctions &functions = functions_[k];
            LaneMask inside = active;
            for (int i = 0; i < 3; ++i)
                inside &=
                    greater_equal(functions(BlockFunctions::EDGE + i, block), broadcast(t.threshold[i][k]));
            const Lanes q = functions(BlockFunctions::Q, block);
            if (GENERAL && clipped >> k & 1) inside &= greater_equal(broadcast(t.q_max[k]), q);
            if (!inside) continue;
            if (entry.covered & inside) {
                active = blend<GENERAL, TAPED>(block, entry);
                inside &= active;
                if (!inside) continue;
            }
            const f4 low = load4(functions.low), high = load4(functions.high);
            if (!entry.covered) {
                // The first triangle fills all lanes, so uncovered lanes are finite.
                entry.q = q;
                for (int c = 0; c < 4; ++c) entry.linear[c] = functions(BlockFunctions::RGBA + c, block);
                entry.low = low;
                entry.high = high;
                entry.q_min = t.q_min[k];
                entry.q_max = t.q_max[k];
            } else {
                entry.q = select(inside, q, entry.q);
                for (int c = 0; c < 4; ++c)
                    entry.linear[c] =
                        select(inside, functions(BlockFunctions::RGBA + c, block), entry.linear[c]);
                entry.low = min4(entry.low, low);
                entry.high = max4(entry.high, high);
                entry.q_min = std::min(entry.q_min, t.q_min[k]);
                entry.q_max = std::max(entry.q_max, t.q_max[k]);
            }
            entry.covered |= inside;
            if (TAPED) tape->add_mask(block, t.face[k], tape_index_[k], inside);
            if (coverage) coverage->add_mask(coverage_index_[k], inside);
            if (TAPED || GENERAL) ++entry.mask_count;
            if (GENERAL && image_.needs_weights()) {
                const Lanes z = broadcast(1) / clamp(q, broadcast(t.q_min[k]), broadcast(t.q_max[k]));
                set_weights(k, block, inside, z, entry.weights);
            }
        }
        if (entry.covered) active = blend<GENERAL, TAPED>(block, entry);
        if (!active) active_blocks_ &= ~((BlockMask)1 << block);
    }

    // Blends an entry and empties it; returns the lanes of the block that are still active.
    template <bool GENERAL, bool TAPED>
    __attribute__((always_inline)) LaneMask blend(int block, Entry &entry) {
        const Lanes z = broadcast(1) / clamp(entry.q, broadcast(entry.q_min), broadcast(entry.q_max));
        Lanes rgba[4];
        for (int c = 0; c < 4; ++c)
            rgba[c] = clamp(entry.linear[c] * z, broadcast(entry.low[c]), broadcast(entry.high[c]));
        if (TAPED) image_.splat_tape()->blocks[block].add_entry(entry.mask_count);
        const LaneMask active = image_.blend_next<GENERAL, TAPED>(block, rgba, entry.covered, &entry.weights,
                                                                  entry.first_mask, entry.mask_count);
        entry.first_mask += entry.mask_count;
        entry.covered = entry.mask_count = 0;
        return active;
    }

    uint32_t coverage_index_[Batch::N];  // of each triangle, in the coverage of the tile
    uint32_t tape_index_[Batch::N];      // likewise on the tape
};

}  // namespace ms
