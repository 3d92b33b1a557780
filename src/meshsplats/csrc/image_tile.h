// Blends the fragments of one tile front to back and resolves its samples to pixels.
#pragma once

#include <limits>

#include "fragment_queue.h"
#include "ramp.h"
#include "scene.h"
#include "tape.h"
#include "tile_area.h"

namespace ms {

// Layout of the sums of one sample for the outputs besides colour: depth, normals, attributes, in this order;
// for the median depth, the weight so far and the depth at which it reached a half, 0 before.
struct ExtraChannels {
    int count = 0;
    int depth = -1, normals = -1, attributes = -1, median = -1;  // first channel, or -1

    ExtraChannels(const MsImage &image, const MsMesh &mesh) {
        if (image.depth) depth = count, count += 1;
        if (image.normals) normals = count, count += 3;
        if (image.attributes) attributes = count, count += mesh.attribute_count;
        if (image.median_depth) median = count, count += 2;
    }
    bool any() const { return count > 0; }
};

// Front-to-back blending of a tile: C = sum_k T_k a_k c_k + T_end background with the transmittance
// T_k = prod_{j<k} (1 - a_j). A sample is active until its transmittance falls below min_transmittance (early
// termination) or until it has blended max_layers fragments.
class ImageTile {
  public:
    ImageTile(const Scene &scene, const MsOptions &options, const MsImage &image, const MsCamera &camera)
        : scene_(scene),
          grid_(scene.grid),
          options_(options),
          image_(image),
          camera_(camera),
          extras_(image, scene.mesh),
          extra_sums_((size_t)MAX_SAMPLES * extras_.count) {
        MS_ASSERT(options.min_transmittance >= 0 && options.min_transmittance < 1 && options.max_layers >= 0);
    }

    // Records a tape of each tile from now on. Then transparent triangles count, too, and fragments behind
    // opaque ones are recorded as if the opaque ones transmitted some light: the gradient of an opacity of 1
    // depends on what lies behind it.
    void record_tape() {
        MS_ASSERT(!has_cutoff(options_) || has_ramp(options_));
        tape_ = std::make_unique<TileTape>();
    }
    void record_splat_tape() {
        MS_ASSERT(!has_cutoff(options_));
        splat_tape_ = std::make_unique<SplatTape>();
    }
    SplatTape *splat_tape() { return splat_tape_.get(); }
    // Packs the tape of the tile into memory that allocate(bytes) returns.
    template <class Allocate>
    bool pack_tape(PackedTape &packed, Allocate &&allocate) {
        return splat_tape_ ? packed.pack(*splat_tape_, allocate) : packed.pack(*tape_, coverage_, allocate);
    }

    // Where to add the coverage masks of queue entries, or null if nothing needs them.
    TileCoverage *coverage() { return tape_ || extras_.any() ? &coverage_ : nullptr; }
    bool keeps_transparent() const { return tape_ || splat_tape_; }
    const MsOptions &options() const { return options_; }
    bool needs_weights() const { return extras_.any(); }
    // Number of fragments blended so far, in all tiles.
    int64_t fragments() const { return fragments_; }
    LaneMask active(int block) const { return active_[block]; }

    void begin(const TileArea &area) {
        area_ = area;
        coverage_.clear();
        if (tape_) tape_->clear();
        if (splat_tape_) splat_tape_->clear();
        std::fill(capped_, capped_ + area.blocks, false);
        for (int i = 0; i < area.blocks * LANES; ++i) {
            layers_[i] = 0;
            color_[0][i] = color_[1][i] = color_[2][i] = 0;
            transmittance_[i] = capped_transmittance_[i] = 1;
        }
        for (int block = 0; block < area.blocks; ++block) active_[block] = area.valid_lanes(block);
        std::fill(extra_sums_.begin(), extra_sums_.end(), 0.0f);
    }

    // Blends the fragments of a queue with keys > nearest_to_come.
    void blend(int block, FragmentQueue &queue, float nearest_to_come) {
        if (extras_.any() || options_.max_layers || tape_)
            drain_queue<true>(block, queue, nearest_to_come);
        else
            drain_queue<false>(block, queue, nearest_to_come);
    }

    // Before fragments of at most this opacity: until one exceeds the cap, the capped transmittance is the
    // transmittance and needs no arithmetic of its own.
    void expect_opacity(int block, float opacity) {
        if (capped_[block] || opacity <= ALPHA_CAP) return;
        capped_[block] = true;
        store_lanes(capped_transmittance_ + block * LANES, load_lanes(transmittance_ + block * LANES));
    }

    // Blends the next fragments of a block, behind all earlier ones, in the lanes `ready`, which are active.
    // Returns the lanes of the block that are still active. TAPED: with a splat tape. GENERAL: perhaps with
    // extra outputs, of these masks and weights, or a layer limit.
    template <bool GENERAL, bool TAPED>
    __attribute__((always_inline)) LaneMask blend_next(int block, const Lanes rgba[4], LaneMask ready,
                                                       const FragmentWeights *weights, uint32_t first_mask,
                                                       uint32_t mask_count) {
        MS_ASSERT(ready && !(ready & ~active_[block]) && TAPED == (splat_tape_ != nullptr));
        const Lanes limit = broadcast(options_.min_transmittance);
        Lanes transmittance = load_lanes(transmittance_ + block * LANES);
        LaneMask blending = ready;
        if (TAPED && capped_[block]) blending &= greater_equal(transmittance, limit);
        const Lanes weight = masked(blending, transmittance * rgba[3]);
        for (int c = 0; c < 3; ++c)
            store_lanes(color_[c] + block * LANES, load_lanes(color_[c] + block * LANES) + weight * rgba[c]);
        transmittance = transmittance - weight;
        store_lanes(transmittance_ + block * LANES, transmittance);
        const LaneMask visible = greater(weight, broadcast(0));
        fragments_ += __builtin_popcount(visible);
        LaneMask left = greater_equal(transmittance, limit);
        if (TAPED && capped_[block]) {
            float *const capped = capped_transmittance_ + block * LANES;
            const Lanes before = load_lanes(capped),
                        after = before - masked(ready, before * min_lanes(rgba[3], broadcast(ALPHA_CAP)));
            store_lanes(capped, after);
            left |= greater_equal(after, limit);
        }
        LaneMask active = active_[block] & left;
        if (GENERAL && extras_.any()) add_extras(block, first_mask, mask_count, *weights, visible, weight);
        if (GENERAL && options_.max_layers) count_layers(block, visible, active);
        return active_[block] = active;
    }

    // Removes from a queue the fragments that are hidden behind others of it, whatever else is pushed.
    void cull(int block, FragmentQueue &queue) {
        // Fragments pushed later can only lower the transmittance, except for rounding: half of the limit is
        // safe.
        const Lanes limit = broadcast(std::max(0.5f * options_.min_transmittance, 1e-30f));
        Lanes transmittance = load_lanes((tape_ ? capped_transmittance_ : transmittance_) + block * LANES);
        const Lanes max_alpha = broadcast(tape_ ? alpha_cap() : 1);
        LaneMask active = active_[block];
        int layers_left[LANES];
        for (int i = 0; i < LANES; ++i)
            layers_left[i] =
                options_.max_layers ? options_.max_layers - layers_[block * LANES + i] : queue.count();
        queue.cull(active, [&](int entry, LaneMask ready) {
            const Lanes alpha = queue.fragments(entry).rgba[3];
            const LaneMask visible = ready & active & (tape_ ? ~0u : greater(alpha, broadcast(0)));
            transmittance = transmittance - masked(visible, transmittance * min_lanes(alpha, max_alpha));
            active &= greater_equal(transmittance, limit);
            for (LaneMask rest = visible; rest; rest &= rest - 1)
                if (--layers_left[__builtin_ctz(rest)] == 0) active &= ~lowest_lane(rest);
            return visible;
        });
    }

    // Averages the samples of each pixel and writes the pixels. Does nothing without an image.
    void resolve() {
        if (!image_.color) return;
        int s = grid_.samples;
        const float count = s * s;  // not times its inverse: 121 / 121 is 1, 121 * (1.0f / 121) is less
        for (int y = 0; y < area_.rows; y += s) {
            for (int x = 0; x < area_.columns; x += s) {
                int64_t pixel = (int64_t)((area_.y0 + y) / s) * camera_.width + (area_.x0 + x) / s;
                float color[3] = {0, 0, 0}, transmittance = 0;
                for (int j = 0; j < s; ++j)
                    for (int i = 0; i < s; ++i) {
                        int sample = TileArea::sample_index(x + i, y + j);
                        for (int c = 0; c < 3; ++c) color[c] += color_[c][sample];
                        transmittance += transmittance_[sample];
                    }
                transmittance /= count;
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c)
                    image_.color[3 * pixel + c] = color[c] / count + transmittance * background[c];
                image_.alpha[pixel] = 1 - transmittance;
                if (extras_.depth >= 0) resolve_extra(image_.depth, extras_.depth, 1, x, y, pixel);
                if (extras_.normals >= 0) resolve_extra(image_.normals, extras_.normals, 3, x, y, pixel);
                if (extras_.attributes >= 0)
                    resolve_extra(image_.attributes, extras_.attributes, scene_.mesh.attribute_count, x, y,
                                  pixel);
                if (extras_.median >= 0) image_.median_depth[pixel] = median_of(x, y);
            }
        }
    }

  private:
    // With a tape, early termination follows the transmittance of alphas limited to this, see record_tape.
    static constexpr float ALPHA_CAP = 0.9f;
    // Ramps end at 1, where their derivative is small or 0.
    static constexpr float RAMP_ALPHA_CAP = 0.999f;
    float alpha_cap() const { return has_ramp(options_) ? RAMP_ALPHA_CAP : ALPHA_CAP; }

    // GENERAL: with extra outputs, a layer limit or a tape.
    template <bool GENERAL>
    void drain_queue(int block, FragmentQueue &queue, float nearest_to_come) {
        float *const transmittances = transmittance_ + block * LANES, *const capped = capped_transmittance_ +
                                                                                      block * LANES;
        Lanes transmittance = load_lanes(transmittances), capped_transmittance = load_lanes(capped), color[3];
        for (int c = 0; c < 3; ++c) color[c] = load_lanes(color_[c] + block * LANES);
        const Lanes limit = broadcast(options_.min_transmittance), max_alpha = broadcast(alpha_cap());
        // `active` includes samples that only record; `blending` are those above the limit.
        LaneMask active = active_[block], blending = greater_equal(transmittance, limit);
        TileTape::Block *tape = tape_ ? &tape_->blocks[block] : nullptr;
        if (tape) tape->reserve(queue.count());
        queue.drain(nearest_to_come, active, [&](int entry, LaneMask ready) {
            const Fragments &f = queue.fragments(entry);
            const Lanes weight =
                masked(ready & (GENERAL ? blending & active : active), transmittance * f.rgba[3]);
            for (int c = 0; c < 3; ++c) color[c] = color[c] + weight * f.rgba[c];
            transmittance = transmittance - weight;
            const LaneMask visible = greater(weight, broadcast(0));
            fragments_ += __builtin_popcount(visible);
            blending = greater_equal(transmittance, limit);
            if (!GENERAL) {
                active &= blending;
                return;
            }
            if (tape) {
                if (ready & active) record_step(*tape, queue, entry, ready & active);
                capped_transmittance =
                    capped_transmittance -
                    masked(ready & active, capped_transmittance * min_lanes(f.rgba[3], max_alpha));
                active &= blending | greater_equal(capped_transmittance, limit);
            } else {
                active &= blending;
            }
            if (extras_.any())
                add_extras(block, queue.first_mask(entry), queue.mask_count(entry), queue.weights(entry),
                           visible, weight);
            if (options_.max_layers) count_layers(block, visible, active);
        });
        MS_ASSERT(!(active & ~active_[block]));
        active_[block] = active;
        store_lanes(transmittances, transmittance);
        if (GENERAL) store_lanes(capped, capped_transmittance);
        for (int c = 0; c < 3; ++c) store_lanes(color_[c] + block * LANES, color[c]);
    }

    static void record_step(TileTape::Block &tape, FragmentQueue &queue, int entry, LaneMask lanes) {
        uint32_t &index = queue.tape_index(entry);
        if (index == FragmentQueue::NOT_RECORDED)
            index = tape.add_entry(queue.first_mask(entry), queue.mask_count(entry));
        tape.add_step(index, lanes);
    }

    // Counts the visible fragments of an entry; samples with all their layers are no longer active.
    void count_layers(int block, LaneMask visible, LaneMask &active) {
        for (LaneMask rest = visible; rest; rest &= rest - 1)
            if (++layers_[block * LANES + __builtin_ctz(rest)] >= options_.max_layers)
                active &= ~lowest_lane(rest);
    }

    // Adds the extra outputs of the visible fragments of an entry, by their blending weights.
    void add_extras(int block, uint32_t first_mask, uint32_t mask_count, const FragmentWeights &fragments,
                    LaneMask visible, const Lanes &weight) {
        alignas(64) float weights[LANES];
        store_lanes(weights, weight);
        const CoverageMask *mask = coverage_.masks.data() + first_mask;
        for (uint32_t i = 0; i < mask_count; ++i) {
            const int32_t face = coverage_.triangles[mask[i].triangle].face;
            for (LaneMask rest = mask[i].lanes & visible; rest; rest &= rest - 1) {
                const int lane = __builtin_ctz(rest);
                add_extras(block * LANES + lane, face, fragments, lane, weights[lane]);
            }
        }
    }

    void add_extras(int sample, int32_t face, const FragmentWeights &fragment, int lane, float weight) {
        const MsMesh &mesh = scene_.mesh;
        float *sum = extra_sums_.data() + (size_t)sample * extras_.count;
        const int32_t *corner = mesh.faces + 3 * (int64_t)face;
        const float z = lane_of(fragment.z, lane);
        float b[3], total = 0;
        for (int k = 0; k < 3; ++k) {
            b[k] = std::min(std::max(lane_of(fragment.b[k], lane), 0.0f), 1.0f);
            total += b[k];
        }
        for (int k = 0; k < 3; ++k) b[k] = total > 0 ? b[k] / total : k == 0;
        if (extras_.depth >= 0) sum[extras_.depth] += weight * z;
        if (extras_.median >= 0) {
            float &stopped = sum[extras_.median], &median = sum[extras_.median + 1];
            stopped += weight;
            if (stopped >= 0.5f && !(median > 0)) median = z;
        }
        if (extras_.normals >= 0) add_normal(sample, corner, b, weight, sum + extras_.normals);
        if (extras_.attributes >= 0) {
            int channels = mesh.attribute_count;
            for (int c = 0; c < channels; ++c) {
                float value = 0;
                for (int k = 0; k < 3; ++k)
                    value += b[k] * mesh.attributes[(int64_t)corner[k] * channels + c];
                sum[extras_.attributes + c] += weight * value;
            }
        }
    }

    // Adds the unit normal in world space, turned towards the camera, times `weight`. A normal of length 0
    // adds 0.
    void add_normal(int sample, const int32_t *corner, const float b[3], float weight, float *sum) {
        double n[3] = {0, 0, 0};
        normal(corner, b, n);
        // The direction of the ray through the sample is (x, y, 1) in camera space.
        const float x = TileArea::column(sample) + 0.5f, y = TileArea::row(sample) + 0.5f;
        const Projection &pr = scene_.projection;
        double ray[3] = {((double)area_.x0 + x - pr.cx) / pr.fx, ((double)area_.y0 + y - pr.cy) / pr.fy, 1};
        double along_ray = 0, length2 = 0;
        for (int k = 0; k < 3; ++k) {
            along_ray += n[k] * (pr.m[k] * ray[0] + pr.m[4 + k] * ray[1] + pr.m[8 + k] * ray[2]);
            length2 += n[k] * n[k];
        }
        if (!(length2 > 0)) return;
        double scale = (along_ray > 0 ? -1 : 1) / std::sqrt(length2) * weight;
        for (int k = 0; k < 3; ++k) sum[k] += (float)(n[k] * scale);
    }

    // The interpolated vertex normal, or that of the face; of any length. `n` is 0.
    void normal(const int32_t *corner, const float b[3], double n[3]) const {
        const MsMesh &mesh = scene_.mesh;
        if (mesh.normals) {
            for (int k = 0; k < 3; ++k)
                for (int c = 0; c < 3; ++c) n[c] += (double)b[k] * mesh.normals[3 * (int64_t)corner[k] + c];
            return;
        }
        const float *p = mesh.vertices + 3 * (int64_t)corner[0], *q = mesh.vertices + 3 * (int64_t)corner[1],
                    *r = mesh.vertices + 3 * (int64_t)corner[2];
        double u[3], v[3];
        for (int k = 0; k < 3; ++k) {
            u[k] = (double)q[k] - p[k];
            v[k] = (double)r[k] - p[k];
        }
        for (int k = 0; k < 3; ++k) n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
    }

    // Averages the samples of the pixel at the tile's sample (x, y) for the channels of one output.
    void resolve_extra(float *out, int first, int channels, int x, int y, int64_t pixel) const {
        const int s = grid_.samples;
        for (int c = 0; c < channels; ++c) {
            float sum = 0;
            for (int j = 0; j < s; ++j)
                for (int i = 0; i < s; ++i)
                    sum +=
                        extra_sums_[(size_t)TileArea::sample_index(x + i, y + j) * extras_.count + first + c];
            out[pixel * channels + c] = sum / (s * s);
        }
    }

    // The mean of the median depths of the samples of the pixel at the tile's sample (x, y) that have one;
    // infinite where fewer than half have.
    float median_of(int x, int y) const {
        const int s = grid_.samples;
        float sum = 0;
        int found = 0;
        for (int j = 0; j < s; ++j)
            for (int i = 0; i < s; ++i) {
                const size_t sample = TileArea::sample_index(x + i, y + j);
                const float depth = extra_sums_[sample * extras_.count + extras_.median + 1];
                if (depth > 0) sum += depth, ++found;
            }
        return 2 * found >= s * s ? sum / found : std::numeric_limits<float>::infinity();
    }

    const Scene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsImage &image_;
    const MsCamera &camera_;
    ExtraChannels extras_;
    TileArea area_;
    alignas(64) float color_[3][MAX_SAMPLES];
    alignas(64) float transmittance_[MAX_SAMPLES];
    alignas(64) float capped_transmittance_[MAX_SAMPLES];  // with alphas limited to alpha_cap()
    bool capped_[MAX_BLOCKS];  // with a splat tape: blocks whose capped transmittance is another
    std::unique_ptr<TileTape> tape_;
    std::unique_ptr<SplatTape> splat_tape_;
    TileCoverage coverage_;
    int32_t layers_[MAX_SAMPLES];  // fragments blended, if there is a layer limit
    LaneMask active_[MAX_BLOCKS];  // active samples
    std::vector<float> extra_sums_;
    int64_t fragments_ = 0;
};

}  // namespace ms
