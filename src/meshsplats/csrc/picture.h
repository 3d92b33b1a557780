// Blends fragments into a picture, front to back.
#pragma once

#include "scene.h"
#include "tile_area.h"
#include "tile_log.h"
#include "waiting.h"

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

class PictureTile {
  public:
    PictureTile(const Scene &scene, const MsOptions &options, const MsPicture &picture,
                const MsCamera &camera)
        : scene_(scene),
          grid_(scene.grid),
          options_(options),
          picture_(picture),
          camera_(camera),
          extras_(picture, scene.mesh),
          sums_((size_t)SAMPLES * extras_.channels) {}

    // From now on keeps a log of what is blended in the tile. Then triangles without opacity count too, and
    // what lies behind an opaque one is followed as if it let some light through: for gradients, that is what
    // making it translucent shows.
    void record() { log_ = std::make_unique<TileLog>(); }
    const TileLog &log() const { return *log_; }
    // Where to note which triangle covers what, or null.
    TilePieces *pieces() { return log_ || extras_.any ? &pieces_ : nullptr; }
    bool keeps_invisible() const { return log_ != nullptr; }
    bool needs_weights() const { return extras_.any; }
    int64_t fragments() const { return fragments_; }
    unsigned open(int block) const { return open_[block]; }

    void begin(const TileArea &area) {
        area_ = area;
        pieces_.clear();
        if (log_) log_->clear();
        for (int i = 0; i < SAMPLES; ++i) {
            layers_[i] = 0;
            color_[0][i] = color_[1][i] = color_[2][i] = 0;
            through_[i] = reach_[i] = 1;
        }
        for (int block = 0; block < BLOCKS; ++block) open_[block] = area.lanes(block);
        std::fill(sums_.begin(), sums_.end(), 0.0f);
    }

    // Blends what is nearer than anything with 1 / depth <= nearest_to_come.
    void blend(int block, Waiting &waiting, float nearest_to_come) {
        if (extras_.any || options_.max_layers || log_)
            blend_entries<true>(block, waiting, nearest_to_come);
        else
            blend_entries<false>(block, waiting, nearest_to_come);
    }

    // Takes from the list what surely stays hidden behind other entries of it.
    void drop_hidden(int block, Waiting &waiting) {
        // Half: more in front can only lower the light, but for the rounding of the last bit.
        const Lanes enough = lanes(std::max(0.5f * options_.min_transmittance, 1e-30f));
        Lanes through = load_lanes((log_ ? reach_ : through_) + block * LANES);
        const Lanes most_opaque = lanes(log_ ? MOST_OPAQUE : 1);
        uint32_t open = open_[block];
        int left[LANES];
        for (int i = 0; i < LANES; ++i)
            left[i] =
                options_.max_layers ? options_.max_layers - layers_[block * LANES + i] : waiting.count();
        waiting.keep(open, [&](int entry, uint32_t ready) {
            const Lanes alpha = waiting.fragments(entry).rgba[3];
            const uint32_t seen = ready & open & (log_ ? ~0u : greater(alpha, lanes(0)));
            through = through - only(seen, through * least(alpha, most_opaque));
            open &= at_least(through, enough);
            for (uint32_t rest = seen; rest; rest &= rest - 1)
                if (--left[__builtin_ctz(rest)] == 0) open &= ~(rest & -rest);
            return seen;
        });
    }

    // Averages the samples of each pixel into the picture.
    void finish() {
        if (!picture_.color) return;
        int s = grid_.samples;
        float share = 1.0f / (s * s);
        for (int y = 0; y < area_.rows; y += s) {
            for (int x = 0; x < area_.columns; x += s) {
                int64_t pixel = (int64_t)((area_.y0 + y) / s) * camera_.width + (area_.x0 + x) / s;
                float color[3] = {0, 0, 0}, through = 0;
                for (int j = 0; j < s; ++j)
                    for (int i = 0; i < s; ++i) {
                        int sample = TileArea::number(x + i, y + j);
                        for (int c = 0; c < 3; ++c) color[c] += color_[c][sample];
                        through += through_[sample];
                    }
                through *= share;
                const float *background =
                    options_.background + (options_.background_per_pixel ? 3 * pixel : 0);
                for (int c = 0; c < 3; ++c)
                    picture_.color[3 * pixel + c] = color[c] * share + through * background[c];
                picture_.alpha[pixel] = 1 - through;
                if (!extras_.any) continue;
                auto average = [&](float *out, int channel, int channels) {
                    for (int c = 0; c < channels; ++c) {
                        float sum = 0;
                        for (int j = 0; j < s; ++j)
                            for (int i = 0; i < s; ++i)
                                sum += sums_[(size_t)TileArea::number(x + i, y + j) * extras_.channels +
                                             channel + c];
                        out[pixel * channels + c] = sum * share;
                    }
                };
                if (extras_.depth >= 0) average(picture_.depth, extras_.depth, 1);
                if (extras_.normals >= 0) average(picture_.normals, extras_.normals, 3);
                if (extras_.attributes >= 0)
                    average(picture_.attributes, extras_.attributes, scene_.mesh.attribute_count);
            }
        }
    }

  private:
    static constexpr float MOST_OPAQUE = 0.9f;

    template <bool GENERAL>
    void blend_entries(int block, Waiting &waiting, float nearest_to_come) {
        float *at = through_ + block * LANES;
        Lanes through = load_lanes(at), reach = load_lanes(reach_ + block * LANES), color[3];
        for (int c = 0; c < 3; ++c) color[c] = load_lanes(color_[c] + block * LANES);
        const Lanes enough = lanes(options_.min_transmittance);
        uint32_t open = open_[block], lit = at_least(through, enough);
        TileLog::Block *log = log_ ? &log_->blocks[block] : nullptr;
        if (log) log->make_room(waiting.count());
        waiting.take(nearest_to_come, open, [&](int entry, uint32_t ready) {
            const Fragments &f = waiting.fragments(entry);
            const Lanes weight = only(ready & (GENERAL ? lit & open : open), through * f.rgba[3]);
            for (int c = 0; c < 3; ++c) color[c] = color[c] + weight * f.rgba[c];
            through = through - weight;
            const uint32_t seen = greater(weight, lanes(0));
            fragments_ += __builtin_popcount(seen);
            if (!GENERAL) {
                open &= at_least(through, enough);
                return;
            }
            lit = at_least(through, enough);
            if (log) {
                if (ready & open) {
                    uint32_t &number = waiting.number(entry);
                    if (number == Waiting::NO_NUMBER) {
                        number = log->entry_count++;
                        log->entries[number] = {waiting.first_piece(entry), waiting.pieces(entry)};
                    }
                    log->steps[log->step_count++] = {number, ready & open};
                }
                reach = reach - only(ready & open, reach * least(f.rgba[3], lanes(MOST_OPAQUE)));
                open &= lit | at_least(reach, enough);
            } else {
                open &= lit;
            }
            if (extras_.any) {
                alignas(64) float weights[LANES];
                store_lanes(weights, weight);
                const Piece *piece = pieces_.pieces.data() + waiting.first_piece(entry);
                for (uint32_t i = 0; i < waiting.pieces(entry); ++i) {
                    for (uint32_t part = piece[i].lanes & seen; part; part &= part - 1) {
                        const int lane = __builtin_ctz(part);
                        add_extras(block * LANES + lane, pieces_.triangles[piece[i].triangle].face,
                                   waiting.weights(entry), lane, weights[lane]);
                    }
                }
            }
            if (options_.max_layers) {
                for (uint32_t rest = seen; rest; rest &= rest - 1)
                    if (++layers_[block * LANES + __builtin_ctz(rest)] >= options_.max_layers)
                        open &= ~(rest & -rest);
            }
        });
        open_[block] = open;
        store_lanes(at, through);
        if (GENERAL) store_lanes(reach_ + block * LANES, reach);
        for (int c = 0; c < 3; ++c) store_lanes(color_[c] + block * LANES, color[c]);
    }

    void add_extras(int sample, int32_t face, const FragmentWeights &at, int lane, float weight) {
        const MsMesh &mesh = scene_.mesh;
        float *sum = sums_.data() + (size_t)sample * extras_.channels;
        const int32_t *corner = mesh.faces + 3 * (int64_t)face;
        const float x = TileArea::column(sample) + 0.5f, y = TileArea::row(sample) + 0.5f;
        const float z = lane_of(at.z, lane);
        float b[3], total = 0;
        for (int k = 0; k < 3; ++k) {
            b[k] = std::min(std::max(lane_of(at.b[k], lane), 0.0f), 1.0f);
            total += b[k];
        }
        for (int k = 0; k < 3; ++k) b[k] = total > 0 ? b[k] / total : k == 0;
        if (extras_.depth >= 0) sum[extras_.depth] += weight * z;
        if (extras_.normals >= 0) {
            double n[3] = {0, 0, 0};
            if (mesh.normals) {
                for (int k = 0; k < 3; ++k)
                    for (int c = 0; c < 3; ++c)
                        n[c] += (double)b[k] * mesh.normals[3 * (int64_t)corner[k] + c];
            } else {
                const float *p = mesh.vertices + 3 * (int64_t)corner[0],
                            *q = mesh.vertices + 3 * (int64_t)corner[1],
                            *r = mesh.vertices + 3 * (int64_t)corner[2];
                double u[3], v[3];
                for (int k = 0; k < 3; ++k) {
                    u[k] = (double)q[k] - p[k];
                    v[k] = (double)r[k] - p[k];
                }
                for (int k = 0; k < 3; ++k)
                    n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
            }
            // The ray through the sample, in the world.
            const Projection &pr = scene_.projection;
            double ray[3] = {((double)area_.x0 + x - pr.cx) / pr.fx, ((double)area_.y0 + y - pr.cy) / pr.fy,
                             1};
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
                for (int k = 0; k < 3; ++k)
                    value += b[k] * mesh.attributes[(int64_t)corner[k] * channels + c];
                sum[extras_.attributes + c] += weight * value;
            }
        }
    }

    const Scene &scene_;
    const Grid &grid_;
    const MsOptions &options_;
    const MsPicture &picture_;
    const MsCamera &camera_;
    Extras extras_;
    TileArea area_;
    alignas(64) float color_[3][SAMPLES];
    alignas(64) float through_[SAMPLES];
    alignas(64) float reach_[SAMPLES];  // the same if nothing were more opaque than MOST_OPAQUE
    std::unique_ptr<TileLog> log_;
    TilePieces pieces_;
    int32_t layers_[SAMPLES];
    uint32_t open_[BLOCKS];  // per block, the samples that still take light
    std::vector<float> sums_;
    int64_t fragments_ = 0;
};

}  // namespace ms
