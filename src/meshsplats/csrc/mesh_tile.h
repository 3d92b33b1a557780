// Rasterizes a mesh into one tile with per-fragment sorting: emits fragments in exact depth order at every
// sample.
//
// The groups of the tile list come nearest first. Fragments wait in one queue per block until they are nearer
// than everything still to come. So the result does not depend on the order in which triangles arrive.
#pragma once

#include "tile_rasterizer.h"

namespace ms {

class MeshTile : public TileRasterizer<MeshTile, 1> {
  public:
    MeshTile(const Scene &scene, ImageTile image) : TileRasterizer(scene, std::move(image)) {}

    void record_tape() { image_.record_tape(); }

  private:
    friend class TileRasterizer<MeshTile, 1>;
    static constexpr bool LAST_FIRST = false;

    // Blends what is nearer than all groups to come.
    void drain(int block, float nearest_to_come) {
        FragmentQueue &queue = queues_[block];
        if (!queue.count()) return;
        image_.blend(block, queue, nearest_to_come);
        if (!image_.active(block)) {
            active_blocks_ &= ~(1u << block);
            queue.clear();
        }
        // Of many triangles that all begin near the camera, nothing can be blended before the last one:
        // without culling, the queue would fill the memory.
        if (queue.crowded()) image_.cull(block, queue);
    }

    void batch_done(float nearest_to_come) {
        for (; full_blocks_; full_blocks_ &= full_blocks_ - 1)
            drain(__builtin_ctz(full_blocks_), nearest_to_come);
    }
    void finish() {
        full_blocks_ = 0;
        for (int block = 0; block < QUADRANT_BLOCKS; ++block) drain(block, -1);
    }

    void rasterize_group(int begin, int end, unsigned clipped) {
        if (clipped || mesh_.depth_group || image_.needs_weights() || has_cutoff(image_.options()))
            push_group<true>(begin, end, clipped);
        else
            push_group<false>(begin, end, 0);
    }

    // Pushes the fragments of the triangles [begin, end) of the batch, all of one group, to the queues of the
    // blocks that they touch. GENERAL: with clipped triangles, depth groups, extra outputs or a cutoff.
    template <bool GENERAL>
    void push_group(int begin, int end, unsigned clipped) {
        MS_ASSERT(begin < end && end <= batch_size_);
        uint8_t triangles_of[QUADRANT_BLOCKS] = {};  // one bit per triangle of the batch
        static_assert(Batch::N <= 8);
        TileCoverage *coverage = image_.coverage();
        if (coverage) coverage->reserve(Batch::N, Batch::N * QUADRANT_BLOCKS);
        unsigned blocks = 0;
        for (int k = begin; k < end; ++k) {
            unsigned touched = set_up_functions(k);
            blocks |= touched;
            if (coverage && touched) coverage_index_[k] = coverage->add_triangle(batch_.face[k]);
            for (; touched; touched &= touched - 1) triangles_of[__builtin_ctz(touched)] |= 1u << k;
        }
        for (; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            rasterize_block<GENERAL>(block, triangles_of[block], clipped, coverage);
        }
    }

    // Rasterizes some triangles of one group into a block. Triangles share a queue entry as long as they do
    // not overlap.
    template <bool GENERAL>
    __attribute__((always_inline)) void rasterize_block(int block, unsigned triangles, unsigned clipped,
                                                        TileCoverage *coverage) {
        const Batch &t = batch_;
        const LaneMask active = image_.active(block);
        FragmentQueue &queue = queues_[block];
        Fragments *f = &queue.next();
        FragmentWeights weights{};
        LaneMask covered = 0;  // by the triangles of the entry
        int32_t first_face = 0;
        uint32_t first_mask = coverage ? coverage->mask_count : 0, mask_count = 0;
        auto push = [&] {
            queue.push(covered, first_face, GENERAL && image_.needs_weights() ? &weights : nullptr,
                       first_mask, mask_count);
            first_mask += mask_count;
        };
        for (; triangles; triangles &= triangles - 1) {
            const int k = __builtin_ctz(triangles);
            const BlockFunctions &functions = functions_[k];
            LaneMask inside = active;
            for (int i = 0; i < 3; ++i)
                inside &=
                    greater_equal(functions(BlockFunctions::EDGE + i, block), broadcast(t.threshold[i][k]));
            Lanes q = functions(BlockFunctions::Q, block);
            if (GENERAL && clipped >> k & 1) inside &= greater_equal(broadcast(t.q_max[k]), q);
            Lanes opacity;
            if (GENERAL && has_cutoff(image_.options())) opacity = cut_opacity(k, block, q, inside);
            if (!inside) continue;
            if (covered & inside) {
                push();
                covered = mask_count = 0;
                f = &queue.next();
            }
            // The first triangle fills all lanes, so uncovered lanes are finite.
            const LaneMask written = covered ? inside : ALL_LANES;
            q = clamp(q, broadcast(t.q_min[k]), broadcast(t.q_max[k]));
            const Lanes z = broadcast(1) / q;
            f->key = select(written, GENERAL ? sort_key(k, block, q) : q, f->key);
            for (int c = 0; c < 4; ++c) {
                const Lanes value = functions(BlockFunctions::RGBA + c, block) * z;
                f->rgba[c] =
                    select(written, clamp(value, broadcast(functions.low[c]), broadcast(functions.high[c])),
                           f->rgba[c]);
            }
            if (GENERAL && has_cutoff(image_.options())) f->rgba[3] = select(written, opacity, f->rgba[3]);
            if (!covered) first_face = t.face[k];
            covered |= inside;
            if (coverage) {
                coverage->add_mask(coverage_index_[k], inside);
                ++mask_count;
            }
            if (GENERAL && image_.needs_weights()) set_weights(k, block, inside, z, weights);
        }
        if (!covered) return;
        push();
        full_blocks_ |= (unsigned)queue.full() << block;
    }

    // The opacity of triangle k with the cutoff. Removes lanes from `inside` that it makes transparent,
    // unless they have a derivative on the tape. 1 / depth is q.
    Lanes cut_opacity(int k, int block, const Lanes &q, LaneMask &inside) const {
        const BlockFunctions &functions = functions_[k];
        const MsOptions &options = image_.options();
        const Lanes z = broadcast(1) / clamp(q, broadcast(batch_.q_min[k]), broadcast(batch_.q_max[k]));
        const Lanes alpha = clamp(functions(BlockFunctions::RGBA + 3, block) * z, broadcast(functions.low[3]),
                                  broadcast(functions.high[3]));
        if (!has_ramp(options)) {
            inside &= greater_equal(alpha, broadcast(options.cutoff));
            return broadcast(1);
        }
        const Ramp ramp =
            opacity_ramp(options, alpha, (broadcast(functions.alpha_a) - alpha * broadcast(batch_.qa[k])) * z,
                         (broadcast(functions.alpha_b) - alpha * broadcast(batch_.qb[k])) * z);
        LaneMask kept = greater(ramp.opacity, broadcast(0));
        if (image_.keeps_transparent()) kept |= greater(ramp.slope, broadcast(0));
        inside &= kept;
        return ramp.opacity;
    }

    // The sort key of triangle k where 1 / depth is q: that of its depth group, if it has one.
    Lanes sort_key(int k, int block, const Lanes &q) const {
        const int32_t group = mesh_.depth_group ? mesh_.depth_group[batch_.face[k]] : -1;
        if (group < 0) return q;
        MS_ASSERT(group < (int32_t)scene_.planes.size());
        const DepthPlane &plane = scene_.planes[group];
        const double corner = plane.q.c + plane.q.a * (area_.x0 + TileArea::block_x(block)) +
                              plane.q.b * (area_.y0 + TileArea::block_y(block));
        const Lanes key = broadcast((float)plane.q.a) * TileArea::samples_x() +
                          (broadcast((float)plane.q.b) * TileArea::samples_y() + broadcast((float)corner));
        return clamp(key, broadcast(plane.q_min), broadcast(plane.q_max));
    }

    uint32_t coverage_index_[Batch::N];  // of each triangle, in the coverage of the tile
    FragmentQueue queues_[QUADRANT_BLOCKS];
    unsigned full_blocks_ = 0;  // blocks whose queues are full
};

}  // namespace ms
