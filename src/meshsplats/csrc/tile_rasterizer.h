// What drawing a tile of a mesh takes in any order of the triangles: going through the groups of the tile
// list and setting up their triangles in batches.
#pragma once

#include "image_tile.h"

namespace ms {

// `Tile` derives from it and has
//     rasterize_group(begin, end, clipped)  takes the triangles [begin, end) of the batch, all of one group
//     batch_done(nearest_to_come)           after each batch; no group to come has a greater key
//     finish()                              after the last batch
//     LAST_FIRST                            whether the last triangle of a group comes first
template <class Tile, int QUADRANTS>
class TileRasterizer {
  public:
    int64_t fragments() const { return image_.fragments(); }
    ImageTile &image() { return image_; }

    void render(int tile_x, int tile_y, const TileEntry *list, int64_t length) {
        tile_x_ = tile_x;
        tile_y_ = tile_y;
        area_ = TileArea(scene_.grid, tile_x, tile_y);
        MS_ASSERT(area_.blocks == QUADRANTS * QUADRANT_BLOCKS);
        image_.begin(area_);
        active_blocks_ = 0;
        batch_size_ = 0;
        for (int block = 0; block < area_.blocks; ++block) {
            if (image_.active(block)) active_blocks_ |= (BlockMask)1 << block;
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
        tile().finish();
        image_.resolve();
    }

  protected:
    // Triangles that are set up together in SIMD lanes.
    using Batch = TriangleSetup<8>;

    // One bit per block.
    using BlockMask = std::conditional_t<QUADRANTS == 1, uint32_t, uint64_t>;
    static int lowest_block(BlockMask blocks) {
        return QUADRANTS == 1 ? __builtin_ctz((unsigned)blocks) : __builtin_ctzll(blocks);
    }

    TileRasterizer(const Scene &scene, ImageTile image)
        : scene_(scene), mesh_(scene.mesh), image_(std::move(image)) {}

    // The linear functions of a triangle. Each is the sum of its value at the corner of a block and of
    // a x + b y relative to that corner, so that a sample costs one addition.
    struct BlockFunctions {
        enum { EDGE = 0, Q = 3, RGBA = 4, COUNT = 8 };  // edge functions, 1 / depth, RGBA / depth
        Lanes at_sample[COUNT];                         // relative to the corner, one lane per sample
        Lanes at_corner[QUADRANTS][COUNT];              // one lane per block
        alignas(16) float low[4], high[4];              // range of RGBA over the triangle's corners
        float alpha_a, alpha_b;                         // opacity / depth per sample along x and y

        void set_at_sample(int function, float a, float b) {
            at_sample[function] = broadcast(a) * TileArea::samples_x() + broadcast(b) * TileArea::samples_y();
        }
        void set_at_corner(int function, int quadrant, float a, float b, float c) {
            const float x = TileArea::block_x(quadrant * QUADRANT_BLOCKS),
                        y = TileArea::block_y(quadrant * QUADRANT_BLOCKS);
            const Lanes corners_x =
                            QUADRANTS == 1 ? TileArea::blocks_x() : TileArea::blocks_x() + broadcast(x),
                        corners_y =
                            QUADRANTS == 1 ? TileArea::blocks_y() : TileArea::blocks_y() + broadcast(y);
            at_corner[quadrant][function] =
                broadcast(a) * corners_x + (broadcast(b) * corners_y + broadcast(c));
        }
        // Values at the samples of a block.
        Lanes operator()(int function, int block) const {
            const Lanes &corners = at_corner[block / QUADRANT_BLOCKS][function];
            return at_sample[function] + broadcast(((const float *)&corners)[block % QUADRANT_BLOCKS]);
        }
    };

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

    // Sets up the functions of triangle k; returns the active blocks that it may touch, one bit each.
    BlockMask set_up_functions(int k) {
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
        float most[3];
        for (int i = 0; i < 3; ++i) {
            const float a = t.ea[i][k], b = t.eb[i][k];
            functions.set_at_sample(BlockFunctions::EDGE + i, a, b);
            // Conservative test: no sample of a block exceeds the value at its corner by more, rounding
            // included.
            most[i] = std::max(a * 0.5f, a * 3.5f) + std::max(b * 0.5f, b * 3.5f);
        }
        BlockMask blocks = 0;
        for (unsigned rest = quadrants_[k]; rest; rest &= rest - 1) {
            const int quadrant = QUADRANTS == 1 ? 0 : __builtin_ctz(rest);
            LaneMask touched = (LaneMask)(active_blocks_ >> quadrant * QUADRANT_BLOCKS) & ALL_LANES;
            for (int i = 0; i < 3; ++i) {
                functions.set_at_corner(BlockFunctions::EDGE + i, quadrant, t.ea[i][k], t.eb[i][k],
                                        t.ec[i][k]);
                touched &= greater_equal(
                    functions.at_corner[quadrant][BlockFunctions::EDGE + i] + broadcast(most[i]),
                    broadcast(t.threshold[i][k]));
            }
            blocks |= (BlockMask)touched << quadrant * QUADRANT_BLOCKS;
        }
        if (!blocks) return 0;
        alignas(16) float plane[3][4];  // coefficients a, b, c of RGBA / depth
        const float (*const s[3])[Batch::N] = {t.sa, t.sb, t.sc};
        for (int i = 0; i < 3; ++i)
            store4(plane[i], set4(s[i][0][k]) * c[0] + set4(s[i][1][k]) * c[1] + set4(s[i][2][k]) * c[2]);
        functions.alpha_a = plane[0][3];
        functions.alpha_b = plane[1][3];
        functions.set_at_sample(BlockFunctions::Q, t.qa[k], t.qb[k]);
        for (int i = 0; i < 4; ++i)
            functions.set_at_sample(BlockFunctions::RGBA + i, plane[0][i], plane[1][i]);
        for (unsigned rest = quadrants_[k]; rest; rest &= rest - 1) {
            const int quadrant = QUADRANTS == 1 ? 0 : __builtin_ctz(rest);
            functions.set_at_corner(BlockFunctions::Q, quadrant, t.qa[k], t.qb[k], t.qc[k]);
            for (int i = 0; i < 4; ++i)
                functions.set_at_corner(BlockFunctions::RGBA + i, quadrant, plane[0][i], plane[1][i],
                                        plane[2][i]);
        }
        store4(functions.low, min4(min4(c[0], c[1]), c[2]));
        store4(functions.high, high);
        return blocks;
    }

  private:
    static constexpr int CACHE_LINE = 64;
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

    // Collects a batch before triangle set-up. Keeps the triangles of a group in one batch if they fit.
    void add_group(const TileEntry &group, uint64_t touching) {
        if (batch_size_ + __builtin_popcountll(touching) > Batch::N && batch_size_ > 0 &&
            !rasterize_batch_before(group.key))
            return;
        while (touching) {
            if (batch_size_ == Batch::N && !rasterize_batch_before(group.key)) return;
            const int next = Tile::LAST_FIRST ? 63 - __builtin_clzll(touching) : __builtin_ctzll(touching);
            touching &= ~((uint64_t)1 << next);
            add_to_batch(group.first, group.first + next);
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
    bool rasterize_batch_before(float nearest_to_come) {
        rasterize_batch();
        tile().batch_done(nearest_to_come);
        return active_blocks_;
    }

    // Sets up the triangles of the batch, hands them to the tile and empties the batch.
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
        find_quadrants(clipped);
        for (int end, begin = 0; begin < batch_size_; begin = end) {
            for (end = begin + 1; end < batch_size_ && group_[end] == group_[begin];) ++end;
            tile().rasterize_group(begin, end, clipped);
        }
        batch_size_ = 0;
    }

    // The quadrants that the triangles of the batch may touch by the boxes of their corners, one bit each.
    void find_quadrants(unsigned clipped) {
        constexpr double slack = 0.25;
        const Batch &t = batch_;
        for (int k = 0; k < Batch::N; ++k) {
            auto halves = [&](const double p[3][Batch::N]) {
                const double least = std::min(std::min(p[0][k], p[1][k]), p[2][k]),
                             most = std::max(std::max(p[0][k], p[1][k]), p[2][k]);
                return (unsigned)(least <= TILE + slack) | (unsigned)(most >= TILE - slack) << 1;
            };
            const unsigned columns = halves(t.x), rows = halves(t.y);
            quadrants_[k] = QUADRANTS == 1 || clipped >> k & 1
                                ? (1u << QUADRANTS) - 1
                                : (rows & 1 ? columns : 0) | (rows & 2 ? columns << 2 : 0);
        }
    }

    Tile &tile() { return static_cast<Tile &>(*this); }

    int tile_x_, tile_y_;
    uint64_t touching_[RING];       // touching_triangles of the next groups
    unsigned quadrants_[Batch::N];  // see find_quadrants
    int32_t group_[Batch::N];       // first triangle of the group of each triangle

  protected:
    const Scene &scene_;
    const MsMesh &mesh_;
    ImageTile image_;
    TileArea area_;
    Batch batch_;
    int batch_size_;
    BlockFunctions functions_[Batch::N];  // of each triangle
    BlockMask active_blocks_;             // blocks with active samples, one bit each
};

}  // namespace ms
