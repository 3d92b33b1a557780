// Finds the fragments of one tile and hands them on in exact order, front to back.
//
// Groups of triangles come nearest first. Their fragments wait in a sorted list for each block of samples; what is
// nearer than anything still to come is blended, so the result does not depend on the order in which triangles arrive.
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
        crossing_ = 0;
        for (int block = 0; block < BLOCKS; ++block) {
            if (blend_.open(block)) takes_ |= 1u << block;
        }
        for (int64_t i = 0; i < length && takes_; ++i) {
            // Groups come in the order of depth, which is no order in memory: data is asked for some groups ahead.
            if (i + 12 < length) __builtin_prefetch(scene_.boxes.data() + list[i + 12].first);
            if (i + 8 < length) prefetch_faces(list[i + 8]);
            if (i + 4 < length) prefetch_corners(list[i + 4]);
            hold_run(list[i]);
        }
        if (takes_) add_held();
        for (int block = 0; block < BLOCKS; ++block) flush(block, -1);
        blend_.finish();
    }

  private:
    bool touches(const TileBox &box) const {
        return (box.x0 <= tile_x_) & (tile_x_ <= box.x1) & (box.y0 <= tile_y_) & (tile_y_ <= box.y1);
    }
    void prefetch_faces(const Entry &run) const {
        for (int32_t f = run.first; f < run.first + run.length; ++f)
            if (touches(scene_.boxes[f])) __builtin_prefetch(mesh_.faces + 3 * (int64_t)f);
    }
    void prefetch_corners(const Entry &run) const {
        for (int32_t f = run.first; f < run.first + run.length; ++f) {
            if (!touches(scene_.boxes[f])) continue;
            for (int k = 0; k < 3; ++k) {
                const int64_t corner = mesh_.faces[3 * (int64_t)f + k];
                __builtin_prefetch(&scene_.vertices[corner]);
                __builtin_prefetch(mesh_.colors + 4 * corner);
            }
        }
    }

    void flush(int block, float nearest_to_come) {
        Waiting &waiting = waiting_[block];
        if (!waiting.count()) return;
        blend_.blend(block, waiting, pool_, nearest_to_come);
        if (!blend_.open(block)) {
            takes_ &= ~(1u << block);
            waiting.clear(pool_);
        }
        // A pile of triangles that all begin near the camera, where nothing can be blended before the last has come,
        // would fill the memory.
        if (waiting.many()) blend_.drop_hidden(block, waiting, pool_);
    }

    // Triangles that may touch the tile gather until there are enough to make ready side by side.
    void hold_run(const Entry &run) {
        Triangles &t = triangles_;
        const TileBox *box = scene_.boxes.data() + run.first;
        for (int32_t i = 0; i < run.length; ++i) {
            if (!touches(box[i])) continue;
            const int32_t f = run.first + i;
            const int32_t *corner = mesh_.faces + 3 * (int64_t)f;
            const Projected &p = scene_.vertices[corner[0]], &q = scene_.vertices[corner[1]],
                            &r = scene_.vertices[corner[2]];
            const bool crosses = !(p.w > 0) | !(q.w > 0) | !(r.w > 0);
            const Projected *corners[3] = {&p, &q, &r};
            for (int k = 0; k < 3; ++k) {
                t.x[k][held_] = corners[k]->x - area_.x0;
                t.y[k][held_] = corners[k]->y - area_.y0;
                t.w[k][held_] = corners[k]->w;
                t.rgba[k][held_] = mesh_.colors + 4 * (int64_t)corner[k];
            }
            t.face[held_] = f;
            run_[held_] = run.first;
            crossing_ |= (unsigned)crosses << held_;
            if (++held_ < Triangles::N) continue;
            add_held();
            for (; full_; full_ &= full_ - 1) flush(__builtin_ctz(full_), run.key);
            if (!takes_) return;
        }
    }

    void add_held() {
        Triangles &t = triangles_;
        t.set_up_in_front();
        for (unsigned rest = crossing_; rest; rest &= rest - 1) {
            int k = __builtin_ctz(rest);
            Vec3 v[3];
            scene_.homogeneous(mesh_.faces + 3 * (int64_t)t.face[k], area_.x0, area_.y0, v);
            t.set_up_crossing(k, v, scene_.projection.near);
        }
        for (int k = 0; k < held_; ++k) {
            const bool visible = (t.rgba[0][k][3] > 0) | (t.rgba[1][k][3] > 0) | (t.rgba[2][k][3] > 0);
            if (!(t.area[k] > 0) || (!visible && !blend_.keeps_invisible())) continue;
            const bool shared_depth = mesh_.depth_group && mesh_.depth_group[t.face[k]] >= 0;
            const bool crosses = crossing_ >> k & 1;
            if (crosses || shared_depth)
                add_triangle<true>(k, run_[k], crosses, shared_depth);
            else
                add_triangle<false>(k, run_[k], false, false);
        }
        held_ = 0;
        crossing_ = 0;
    }

    // Adds the fragments of a triangle to the lists of the blocks it touches.
    template <bool GENERAL>
    void add_triangle(int k, int32_t run, bool crossing, bool shared_depth) {
        const Triangles &t = triangles_;
        // Each linear function is (a x + b y inside a block) + (a x + b y + c at the block's corner).
        const Lanes x = TileArea::lane_x(), y = TileArea::lane_y();
        alignas(64) static const float block_x[BLOCKS] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12},
                                       block_y[BLOCKS] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};
        Lanes inside_block[4];
        alignas(64) float at_block[4][BLOCKS];
        unsigned blocks = takes_;
        for (int i = 0; i < 4; ++i) {
            float a = i < 3 ? t.ea[i][k] : t.qa[k], b = i < 3 ? t.eb[i][k] : t.qb[k], c = i < 3 ? t.ec[i][k] : t.qc[k];
            const Lanes va = lanes(a), vb = lanes(b);
            inside_block[i] = va * x + vb * y;
            const Lanes corners = va * load_lanes(block_x) + (vb * load_lanes(block_y) + lanes(c));
            store_lanes(at_block[i], corners);
            if (i == 3) continue;
            // No sample of a block exceeds its corner's value by more than this, rounding included.
            float most = std::max(a * 0.5f, a * 3.5f) + std::max(b * 0.5f, b * 3.5f);
            blocks &= at_least(corners + lanes(most), lanes(t.threshold[i][k]));
        }
        if (!blocks) return;
        const Lanes q_min = lanes(t.q_min[k]), q_max = lanes(t.q_max[k]);
        const int32_t place = prepare(k, !shared_depth);
        TileTriangle &triangle = pool_[place];
        for (; blocks; blocks &= blocks - 1) {
            int block = __builtin_ctz(blocks);
            unsigned inside = blend_.open(block);
            for (int i = 0; i < 3; ++i)
                inside &= at_least(inside_block[i] + lanes(at_block[i][block]), lanes(t.threshold[i][k]));
            Lanes q = inside_block[3] + lanes(at_block[3][block]);
            if (GENERAL && crossing) inside &= at_least(q_max, q);
            q = clamp(q, q_min, q_max);
            if (GENERAL && shared_depth) {
                const DepthPlane &plane = scene_.planes[mesh_.depth_group[t.face[k]]];
                double corner = plane.q.c + plane.q.a * (area_.x0 + block_x[block]) + plane.q.b * (area_.y0 + block_y[block]);
                q = lanes((float)plane.q.a) * x + (lanes((float)plane.q.b) * y + lanes((float)corner));
                q = clamp(q, lanes(plane.q_min), lanes(plane.q_max));
            }
            Waiting &waiting = waiting_[block];
            waiting.add(triangle, place, run, inside, q);
            full_ |= (unsigned)waiting.full() << block;
        }
        if (triangle.uses == 0) pool_.drop(place);
    }

    int32_t prepare(int k, bool keys_are_depths) {
        const Triangles &t = triangles_;
        int32_t place = pool_.take();
        TileTriangle &p = pool_[place];
        const f4 c[3] = {load4(t.rgba[0][k]), load4(t.rgba[1][k]), load4(t.rgba[2][k])};
        auto mix = [&](float *out, const float s[3][Triangles::N]) {
            store4(out, set4(s[0][k]) * c[0] + set4(s[1][k]) * c[1] + set4(s[2][k]) * c[2]);
        };
        mix(p.a, t.sa);
        mix(p.b, t.sb);
        mix(p.c, t.sc);
        store4(p.low, min4(min4(c[0], c[1]), c[2]));
        store4(p.high, max4(max4(c[0], c[1]), c[2]));
        p.qa = t.qa[k];
        p.qb = t.qb[k];
        p.qc = t.qc[k];
        p.q_min = t.q_min[k];
        p.q_max = t.q_max[k];
        p.face = t.face[k];
        p.number = blend_.number(t.face[k]);
        p.uses = 0;
        p.keys_are_depths = keys_are_depths;
        if (blend_.needs_weights()) {
            for (int i = 0; i < 3; ++i) {
                p.sa[i] = t.sa[i][k];
                p.sb[i] = t.sb[i][k];
                p.sc[i] = t.sc[i][k];
            }
        }
        return place;
    }

    const Scene &scene_;
    const MsMesh &mesh_;
    Blend blend_;
    int tile_x_, tile_y_;
    TileArea area_;
    Triangles triangles_;
    int held_;                      // triangles gathered
    unsigned crossing_;             // those of them that cross the near plane
    int32_t run_[Triangles::N];
    TilePool pool_;
    Waiting waiting_[BLOCKS];
    unsigned takes_;  // blocks that still take light
    unsigned full_;   // blocks whose lists have become long
};

}  // namespace ms
