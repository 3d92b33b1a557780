// Rasterizes a mesh into one tile: emits fragments in exact depth order at every sample.
//
// The groups of the tile list come nearest first. Fragments wait in one queue per block until they are nearer
// than everything still to come. So the result does not depend on the order in which triangles arrive.
#pragma once

#include "image_tile.h"

namespace ms {

class MeshTile {
  public:
    MeshTile(const Scene &scene, ImageTile image)
        : scene_(scene), mesh_(scene.mesh), image_(std::move(image)) {}

    int64_t fragments() const { return image_.fragments(); }
    ImageTile &image() { return image_; }

    void render(int tile_x, int tile_y, const TileEntry *list, int64_t length) {
        tile_x_ = tile_x;
        tile_y_ = tile_y;
        area_ = TileArea(scene_.grid, tile_x, tile_y);
        image_.begin(area_);
        active_blocks_ = full_blocks_ = 0;
        batch_size_ = 0;
        for (int block = 0; block < BLOCKS; ++block) {
            if (image_.active(block)) active_blocks_ |= 1u << block;
        }
        // Depth order is random in memory: prefetch a few groups ahead.
        for (int64_t i = 0; i < std::min<int64_t>(length, FACES_AHEAD); ++i) prefetch_faces(list, i);
        for (int64_t i = 0; i < std::min<int64_t>(length, CORNERS_AHEAD); ++i) prefetch_corners(list, i);
        for (int64_t i = 0; i < length && active_blocks_; ++i) {
            MS_ASSERT(i == 0 || list[i].key <= list[i - 1].key);
            if (i + BOXES_AHEAD < length)
                __builtin_prefetch(scene_.boxes.data() + list[i + BOXES_AHEAD].first);
            if (i + FACES_AHEAD < length) prefetch_faces(list, i + FACES_AHEAD);
            if (i + CORNERS_AHEAD < length) prefetch_corners(list, i + CORNERS_AHEAD);
            add_group(list[i], touching_[i % RING]);
        }
        if (active_blocks_) rasterize_batch();
        for (int block = 0; block < BLOCKS; ++block) drain(block, -1);
        image_.resolve();
    }

  private:
    // Triangles that are set up together in SIMD lanes.
    using Batch = TriangleSetup<8>;

    // Prefetch distances in groups. RING is a power of two above all of them.
    static constexpr int BOXES_AHEAD = 12, FACES_AHEAD = 8, CORNERS_AHEAD = 3, RING = 16;

    // The triangles of a group that may touch the tile, one bit each.
    uint64_t touching_triangles(const TileEntry &group) const {
        MS_ASSERT(group.length >= 1 && group.length <= 64);
        MS_ASSERT(group.first >= 0 && group.first + group.length <= mesh_.face_count);
        const TileBox *box = scene_.boxes.data() + group.first;
        const TilePosition tile(tile_x_, tile_y_);
        uint64_t bits = 0;
        for (int i = 0; i < group.length; ++i) bits |= (uint64_t)box[i].contains(tile) << i;
        return bits;
    }
    void prefetch_faces(const TileEntry *list, int64_t i) {
        touching_[i % RING] = touching_triangles(list[i]);
        const char *faces = (const char *)(mesh_.faces + 3 * (int64_t)list[i].first);
        for (int64_t byte = 0; byte < list[i].length * (int64_t)(3 * sizeof(int32_t)); byte += CACHE_LINE)
            __builtin_prefetch(faces + byte);
    }
    // Always inlined: GCC takes a function that only prefetches for one without effect and drops calls of it.
    __attribute__((always_inline)) void prefetch_corners(const TileEntry *list, int64_t i) {
        for (uint64_t rest = touching_[i % RING]; rest; rest &= rest - 1) {
            const int32_t *face = mesh_.faces + 3 * ((int64_t)list[i].first + __builtin_ctzll(rest));
            for (int k = 0; k < 3; ++k) {
                __builtin_prefetch(&scene_.vertices[face[k]]);
                __builtin_prefetch(mesh_.colors + 4 * (int64_t)face[k]);
            }
        }
    }

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

    // Collects a batch before triangle set-up. Keeps the triangles of a group in one batch if they fit.
    void add_group(const TileEntry &group, uint64_t touching) {
        if (batch_size_ + __builtin_popcountll(touching) > Batch::N && batch_size_ > 0 &&
            !rasterize_and_drain(group.key))
            return;
        for (; touching; touching &= touching - 1) {
            if (batch_size_ == Batch::N && !rasterize_and_drain(group.key)) return;
            add_to_batch(group.first, group.first + __builtin_ctzll(touching));
        }
    }

    void add_to_batch(int32_t group, int32_t face) {
        MS_ASSERT(batch_size_ < Batch::N);
        Batch &t = batch_;
        const int32_t *corner = mesh_.faces + 3 * (int64_t)face;
        for (int k = 0; k < 3; ++k) {
            const Projected &p = scene_.vertices[corner[k]];
            t.x[k][batch_size_] = p.x - area_.x0;
            t.y[k][batch_size_] = p.y - area_.y0;
            t.w[k][batch_size_] = p.w;
            t.rgba[k][batch_size_] = mesh_.colors + 4 * (int64_t)corner[k];
        }
        t.face[batch_size_] = face;
        group_[batch_size_++] = group;
    }

    // Rasterizes the batch. No group to come is nearer than `nearest_to_come`. False if no block is active
    // any more.
    bool rasterize_and_drain(float nearest_to_come) {
        rasterize_batch();
        for (; full_blocks_; full_blocks_ &= full_blocks_ - 1)
            drain(__builtin_ctz(full_blocks_), nearest_to_come);
        return active_blocks_;
    }

    // Sets up the triangles of the batch, pushes their fragments and empties the batch.
    void rasterize_batch() {
        Batch &t = batch_;
        t.set_up_visible();
        unsigned clipped = 0;  // one bit per triangle
        for (int k = 0; k < batch_size_; ++k) clipped |= (unsigned)t.is_clipped(k) << k;
        for (unsigned rest = clipped; rest; rest &= rest - 1) {
            int k = __builtin_ctz(rest);
            Vec3 v[3];
            scene_.homogeneous_corners(mesh_.faces + 3 * (int64_t)t.face[k], area_.x0, area_.y0, v);
            t.set_up_clipped(k, v, scene_.projection.near);
        }
        for (int end, begin = 0; begin < batch_size_; begin = end) {
            for (end = begin + 1; end < batch_size_ && group_[end] == group_[begin];) ++end;
            if (clipped || mesh_.depth_group || image_.needs_weights() || has_cutoff(image_.options()))
                rasterize_group<true>(begin, end, clipped);
            else
                rasterize_group<false>(begin, end, 0);
        }
        batch_size_ = 0;
    }

    // The linear functions of a triangle. Each is the sum of its value at the corner of a block and of
    // a x + b y relative to that corner, so that a sample costs one addition.
    struct BlockFunctions {
        enum { EDGE = 0, Q = 3, RGBA = 4, COUNT = 8 };  // edge functions, 1 / depth, RGBA / depth
        Lanes at_sample[COUNT];                         // relative to the corner, one lane per sample
        Lanes at_corner[COUNT];                         // one lane per block
        alignas(16) float low[4], high[4];              // range of RGBA over the triangle's corners
        float alpha_a, alpha_b;                         // opacity / depth per sample along x and y

        void set(int function, float a, float b, float c) {
            const Lanes va = broadcast(a), vb = broadcast(b);
            at_sample[function] = va * TileArea::samples_x() + vb * TileArea::samples_y();
            at_corner[function] = va * TileArea::blocks_x() + (vb * TileArea::blocks_y() + broadcast(c));
        }
        // Values at the samples of a block.
        Lanes operator()(int function, int block) const {
            return at_sample[function] + broadcast(((const float *)&at_corner[function])[block]);
        }
    };

    // Pushes the fragments of the triangles [begin, end) of the batch, all of one group, to the queues of the
    // blocks that they touch. GENERAL: with clipped triangles, depth groups, extra outputs or a cutoff.
    template <bool GENERAL>
    void rasterize_group(int begin, int end, unsigned clipped) {
        MS_ASSERT(begin < end && end <= batch_size_);
        uint8_t triangles_of[BLOCKS] = {};  // one bit per triangle of the batch
        static_assert(Batch::N <= 8);
        TileCoverage *coverage = image_.coverage();
        if (coverage) coverage->reserve(Batch::N, Batch::N * BLOCKS);
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

    // Depth and barycentric weights of triangle k in the lanes `inside`.
    void set_weights(int k, int block, LaneMask inside, const Lanes &z, FragmentWeights &weights) const {
        const Batch &t = batch_;
        const float x = TileArea::block_x(block), y = TileArea::block_y(block);
        weights.z = select(inside, z, weights.z);
        for (int i = 0; i < 3; ++i) {
            const Lanes s = (broadcast(t.sa[i][k]) * TileArea::samples_x() +
                             broadcast(t.sb[i][k]) * TileArea::samples_y()) +
                            broadcast(t.sa[i][k] * x + (t.sb[i][k] * y + t.sc[i][k]));
            weights.b[i] = select(inside, s * z, weights.b[i]);
        }
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

    // Sets up the functions of triangle k; returns the active blocks that it may touch, one bit each.
    unsigned set_up_functions(int k) {
        const Batch &t = batch_;
        const f4 c[3] = {load4(t.rgba[0][k]), load4(t.rgba[1][k]), load4(t.rgba[2][k])};
        const f4 high = max4(max4(c[0], c[1]), c[2]);
        if (!(t.valid[k] > 0)) return 0;
        const MsOptions &options = image_.options();
        if (has_cutoff(options) && !has_ramp(options)) {
            if (high[3] < options.cutoff) return 0;
        } else if (!(high[3] > 0) && !image_.keeps_transparent()) {
            return 0;
        }
        BlockFunctions &functions = functions_[k];
        unsigned blocks = active_blocks_;
        for (int i = 0; i < 3; ++i) {
            const float a = t.ea[i][k], b = t.eb[i][k];
            functions.set(BlockFunctions::EDGE + i, a, b, t.ec[i][k]);
            // Conservative test: no sample of a block exceeds the value at its corner by more, rounding
            // included.
            const float most = std::max(a * 0.5f, a * 3.5f) + std::max(b * 0.5f, b * 3.5f);
            blocks &= greater_equal(functions.at_corner[BlockFunctions::EDGE + i] + broadcast(most),
                                    broadcast(t.threshold[i][k]));
        }
        if (!blocks) return 0;
        functions.set(BlockFunctions::Q, t.qa[k], t.qb[k], t.qc[k]);
        alignas(16) float plane[3][4];  // coefficients a, b, c of RGBA / depth
        const float (*const s[3])[Batch::N] = {t.sa, t.sb, t.sc};
        for (int i = 0; i < 3; ++i)
            store4(plane[i], set4(s[i][0][k]) * c[0] + set4(s[i][1][k]) * c[1] + set4(s[i][2][k]) * c[2]);
        functions.alpha_a = plane[0][3];
        functions.alpha_b = plane[1][3];
        for (int i = 0; i < 4; ++i)
            functions.set(BlockFunctions::RGBA + i, plane[0][i], plane[1][i], plane[2][i]);
        store4(functions.low, min4(min4(c[0], c[1]), c[2]));
        store4(functions.high, high);
        return blocks;
    }

    static constexpr int CACHE_LINE = 64;

    const Scene &scene_;
    const MsMesh &mesh_;
    ImageTile image_;
    int tile_x_, tile_y_;
    TileArea area_;
    uint64_t touching_[RING];  // touching_triangles of the next groups
    Batch batch_;
    int batch_size_;
    int32_t group_[Batch::N];             // first triangle of the group of each triangle
    uint32_t coverage_index_[Batch::N];   // of each triangle, in the coverage of the tile
    BlockFunctions functions_[Batch::N];  // of each triangle
    FragmentQueue queues_[BLOCKS];
    unsigned active_blocks_;  // blocks with active samples, one bit each
    unsigned full_blocks_;    // blocks whose queues are full
};

}  // namespace ms
