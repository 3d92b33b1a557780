// Finds the fragments of one tile and hands them on in exact order, front to back.
//
// Groups of triangles come nearest first. Their fragments wait in a sorted list for each block of samples;
// what is nearer than anything still to come is blended, so the result does not depend on the order in which
// triangles arrive.
#pragma once

#include "picture.h"

namespace ms {

// `Blend` takes the fragments: PictureTile, or GradientTile to go back.
template <class Blend>
class MeshTile {
  public:
    MeshTile(const Scene &scene, Blend blend) : scene_(scene), mesh_(scene.mesh), blend_(std::move(blend)) {}

    int64_t fragments() const { return blend_.fragments(); }
    Blend &blend() { return blend_; }

    void draw(int tile_x, int tile_y, const Entry *list, int64_t length) {
        tile_x_ = tile_x;
        tile_y_ = tile_y;
        area_ = TileArea(scene_.grid, tile_x, tile_y);
        blend_.begin(area_);
        full_ = takes_ = 0;
        held_ = 0;
        for (int block = 0; block < BLOCKS; ++block) {
            if (blend_.open(block)) takes_ |= 1u << block;
        }
        // Groups come in the order of depth, which is no order in memory: data is asked for some groups
        // ahead.
        for (int64_t i = 0; i < std::min<int64_t>(length, FACES_AHEAD); ++i) ask_for_faces(list, i);
        for (int64_t i = 0; i < std::min<int64_t>(length, CORNERS_AHEAD); ++i) ask_for_corners(list, i);
        for (int64_t i = 0; i < length && takes_; ++i) {
            if (i + BOXES_AHEAD < length)
                __builtin_prefetch(scene_.boxes.data() + list[i + BOXES_AHEAD].first);
            if (i + FACES_AHEAD < length) ask_for_faces(list, i + FACES_AHEAD);
            if (i + CORNERS_AHEAD < length) ask_for_corners(list, i + CORNERS_AHEAD);
            hold_run(list[i], touching_[i % RING]);
        }
        if (takes_) add_held();
        for (int block = 0; block < BLOCKS; ++block) flush(block, -1);
        blend_.finish();
    }

  private:
    using Triangles = ms::Triangles<8>;

    static constexpr int BOXES_AHEAD = 12, FACES_AHEAD = 8, CORNERS_AHEAD = 3, RING = 16;

    // Which triangles of a run may touch the tile: a bit each.
    uint64_t touching(const Entry &run) const {
        const TileBox *box = scene_.boxes.data() + run.first;
        const TileNumber tile(tile_x_, tile_y_);
        uint64_t bits = 0;
        for (int i = 0; i < run.length; ++i) bits |= (uint64_t)box[i].has(tile) << i;
        return bits;
    }
    void ask_for_faces(const Entry *list, int64_t i) {
        touching_[i % RING] = touching(list[i]);
        const char *faces = (const char *)(mesh_.faces + 3 * (int64_t)list[i].first);
        for (int64_t byte = 0; byte < list[i].length * (int64_t)(3 * sizeof(int32_t)); byte += 64)
            __builtin_prefetch(faces + byte);
    }
    // (GCC takes a function that only prefetches for one without effect, and drops calls that it does not
    // inline first.)
    __attribute__((always_inline)) void ask_for_corners(const Entry *list, int64_t i) {
        for (uint64_t rest = touching_[i % RING]; rest; rest &= rest - 1) {
            const int32_t *face = mesh_.faces + 3 * ((int64_t)list[i].first + __builtin_ctzll(rest));
            for (int k = 0; k < 3; ++k) {
                __builtin_prefetch(&scene_.vertices[face[k]]);
                __builtin_prefetch(mesh_.colors + 4 * (int64_t)face[k]);
            }
        }
    }

    void flush(int block, float nearest_to_come) {
        Waiting &waiting = waiting_[block];
        if (!waiting.count()) return;
        blend_.blend(block, waiting, nearest_to_come);
        if (!blend_.open(block)) {
            takes_ &= ~(1u << block);
            waiting.clear();
        }
        // A pile of triangles that all begin near the camera, where nothing can be blended before the last
        // has come, would fill the memory.
        if (waiting.many()) blend_.drop_hidden(block, waiting);
    }

    // Triangles gather until there are enough to make ready side by side; those of a run stay together if
    // they can.
    void hold_run(const Entry &run, uint64_t touching) {
        if (held_ + __builtin_popcountll(touching) > Triangles::N && held_ > 0 && !add_and_flush(run.key))
            return;
        for (; touching; touching &= touching - 1) {
            if (held_ == Triangles::N && !add_and_flush(run.key)) return;
            hold(run.first, run.first + __builtin_ctzll(touching));
        }
    }

    void hold(int32_t run, int32_t face) {
        Triangles &t = triangles_;
        const int32_t *corner = mesh_.faces + 3 * (int64_t)face;
        for (int k = 0; k < 3; ++k) {
            const Projected &p = scene_.vertices[corner[k]];
            t.x[k][held_] = p.x - area_.x0;
            t.y[k][held_] = p.y - area_.y0;
            t.w[k][held_] = p.w;
            t.rgba[k][held_] = mesh_.colors + 4 * (int64_t)corner[k];
        }
        t.face[held_] = face;
        run_[held_++] = run;
    }

    // Nothing of the groups to come is nearer than `nearest_to_come`. False when no block takes light any
    // more.
    bool add_and_flush(float nearest_to_come) {
        add_held();
        for (; full_; full_ &= full_ - 1) flush(__builtin_ctz(full_), nearest_to_come);
        return takes_;
    }

    void add_held() {
        Triangles &t = triangles_;
        t.set_up_in_front();
        unsigned crossing = 0;
        for (int k = 0; k < held_; ++k)
            crossing |= (unsigned)(!(t.w[0][k] > 0) | !(t.w[1][k] > 0) | !(t.w[2][k] > 0)) << k;
        for (unsigned rest = crossing; rest; rest &= rest - 1) {
            int k = __builtin_ctz(rest);
            Vec3 v[3];
            scene_.homogeneous(mesh_.faces + 3 * (int64_t)t.face[k], area_.x0, area_.y0, v);
            t.set_up_crossing(k, v, scene_.projection.near);
        }
        for (int end, begin = 0; begin < held_; begin = end) {
            for (end = begin + 1; end < held_ && run_[end] == run_[begin];) ++end;
            if (crossing || mesh_.depth_group || blend_.needs_weights())
                add_run<true>(begin, end, crossing);
            else
                add_run<false>(begin, end, 0);
        }
        held_ = 0;
    }

    // The functions of a triangle that samples need, each as (a x + b y inside a block) + (a x + b y + c at
    // its corner).
    struct Functions {
        Lanes inside[8];                    // edges, 1 / depth, RGBA / depth
        Lanes corner[8];                    // by block
        alignas(16) float low[4], high[4];  // range of RGBA over the corners
    };

    // Adds the fragments of the held triangles [begin, end), of one run, to the lists of the blocks they
    // touch.
    template <bool GENERAL>
    void add_run(int begin, int end, unsigned crossing) {
        const Triangles &t = triangles_;
        uint8_t touching[BLOCKS] = {};
        TilePieces *found = blend_.pieces();
        if (found) found->make_room(Triangles::N, Triangles::N * BLOCKS);
        uint32_t number[Triangles::N];
        unsigned blocks = 0;
        for (int k = begin; k < end; ++k) {
            unsigned touched = prepare(k);
            blocks |= touched;
            if (found && touched) {
                number[k] = found->triangle_count;
                found->triangles[found->triangle_count++] = {t.face[k], TilePieces::NONE};
            }
            for (; touched; touched &= touched - 1) touching[__builtin_ctz(touched)] |= 1u << k;
        }
        for (; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            const unsigned open = blend_.open(block);
            Waiting &waiting = waiting_[block];
            Fragments *f = &waiting.next();
            FragmentWeights weights{};
            unsigned covered = 0;
            int32_t face = 0;
            uint32_t first_piece = found ? found->piece_count : 0, pieces = 0;
            auto add = [&] {
                waiting.add(covered, face, GENERAL && blend_.needs_weights() ? &weights : nullptr,
                            first_piece, pieces);
                first_piece += pieces;
            };
            for (unsigned rest = touching[block]; rest; rest &= rest - 1) {
                const int k = __builtin_ctz(rest);
                const Functions &of = functions_[k];
                unsigned inside = open;
                for (int i = 0; i < 3; ++i)
                    inside &= at_least(of.inside[i] + corner(of, i, block), lanes(t.threshold[i][k]));
                Lanes q = of.inside[3] + corner(of, 3, block);
                if (GENERAL && crossing >> k & 1) inside &= at_least(lanes(t.q_max[k]), q);
                if (!inside) continue;
                if (covered & inside) {
                    add();
                    covered = pieces = 0;
                    f = &waiting.next();
                }
                // What the first triangle of an entry has outside of itself is finite, too.
                const unsigned put = covered ? inside : (1u << LANES) - 1;
                q = clamp(q, lanes(t.q_min[k]), lanes(t.q_max[k]));
                const Lanes z = lanes(1) / q;
                f->key = pick(put, GENERAL ? key(k, block, q) : q, f->key);
                for (int c = 0; c < 4; ++c) {
                    const Lanes value = (of.inside[4 + c] + corner(of, 4 + c, block)) * z;
                    f->rgba[c] = pick(put, clamp(value, lanes(of.low[c]), lanes(of.high[c])), f->rgba[c]);
                }
                if (!covered) face = t.face[k];
                covered |= inside;
                if (found) {
                    found->pieces[found->piece_count++] = {number[k], inside};
                    ++pieces;
                }
                if (GENERAL && blend_.needs_weights()) {
                    const float x = TileArea::block_x(block), y = TileArea::block_y(block);
                    weights.z = pick(inside, z, weights.z);
                    for (int i = 0; i < 3; ++i) {
                        const Lanes b = (lanes(t.sa[i][k]) * TileArea::lane_x() +
                                         lanes(t.sb[i][k]) * TileArea::lane_y()) +
                                        lanes(t.sa[i][k] * x + (t.sb[i][k] * y + t.sc[i][k]));
                        weights.b[i] = pick(inside, b * z, weights.b[i]);
                    }
                }
            }
            if (!covered) continue;
            add();
            full_ |= (unsigned)waiting.full() << block;
        }
    }

    static Lanes corner(const Functions &of, int function, int block) {
        return lanes(((const float *)&of.corner[function])[block]);
    }

    // What the fragments of triangle k are sorted by, where 1 / depth is q.
    Lanes key(int k, int block, const Lanes &q) const {
        const int32_t group = mesh_.depth_group ? mesh_.depth_group[triangles_.face[k]] : -1;
        if (group < 0) return q;
        const DepthPlane &plane = scene_.planes[group];
        const double corner = plane.q.c + plane.q.a * (area_.x0 + TileArea::block_x(block)) +
                              plane.q.b * (area_.y0 + TileArea::block_y(block));
        const Lanes common = lanes((float)plane.q.a) * TileArea::lane_x() +
                             (lanes((float)plane.q.b) * TileArea::lane_y() + lanes((float)corner));
        return clamp(common, lanes(plane.q_min), lanes(plane.q_max));
    }

    // Fills the functions of triangle k; returns the blocks it may touch.
    unsigned prepare(int k) {
        const Triangles &t = triangles_;
        const f4 c[3] = {load4(t.rgba[0][k]), load4(t.rgba[1][k]), load4(t.rgba[2][k])};
        const f4 high = max4(max4(c[0], c[1]), c[2]);
        if (!(t.area[k] > 0) || (!(high[3] > 0) && !blend_.keeps_invisible())) return 0;
        Functions &of = functions_[k];
        const Lanes x = TileArea::lane_x(), y = TileArea::lane_y(), block_x = TileArea::blocks_x(),
                    block_y = TileArea::blocks_y();
        auto split = [&](int i, float a, float b, float c) {
            const Lanes va = lanes(a), vb = lanes(b);
            of.inside[i] = va * x + vb * y;
            of.corner[i] = va * block_x + (vb * block_y + lanes(c));
        };
        unsigned blocks = takes_;
        for (int i = 0; i < 3; ++i) {
            const float a = t.ea[i][k], b = t.eb[i][k];
            split(i, a, b, t.ec[i][k]);
            // No sample of a block exceeds its corner's value by more than this, rounding included.
            const float most = std::max(a * 0.5f, a * 3.5f) + std::max(b * 0.5f, b * 3.5f);
            blocks &= at_least(of.corner[i] + lanes(most), lanes(t.threshold[i][k]));
        }
        if (!blocks) return 0;
        split(3, t.qa[k], t.qb[k], t.qc[k]);
        alignas(16) float plane[3][4];
        const float (*const s[3])[Triangles::N] = {t.sa, t.sb, t.sc};
        for (int i = 0; i < 3; ++i)
            store4(plane[i], set4(s[i][0][k]) * c[0] + set4(s[i][1][k]) * c[1] + set4(s[i][2][k]) * c[2]);
        for (int i = 0; i < 4; ++i) split(4 + i, plane[0][i], plane[1][i], plane[2][i]);
        store4(of.low, min4(min4(c[0], c[1]), c[2]));
        store4(of.high, high);
        return blocks;
    }

    const Scene &scene_;
    const MsMesh &mesh_;
    Blend blend_;
    int tile_x_, tile_y_;
    TileArea area_;
    uint64_t touching_[RING];  // of the groups to come
    Triangles triangles_;
    int held_;  // triangles gathered
    int32_t run_[Triangles::N];
    Functions functions_[Triangles::N];
    Waiting waiting_[BLOCKS];
    unsigned takes_;  // blocks that still take light
    unsigned full_;   // blocks whose lists have become long
};

}  // namespace ms
