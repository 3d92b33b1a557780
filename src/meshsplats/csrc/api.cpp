// The plain C interface of the core. Callers validate arguments and own the memory of results: see
// _core/library.py.
#include <cstdio>
#include <iterator>
#include <memory>
#include <new>

#include "adam.h"
#include "cpu.h"
#include "edges.h"
#include "fans.h"
#include "gradient.h"
#include "hidden_new.h"
#include "layout.h"
#ifndef MS_WIDE_ONLY
#include "cells.h"
#include "consistency.h"
#include "fusion.h"
#include "listing.h"
#include "merging.h"
#include "nearest.h"
#include "ordering.h"
#include "resampling.h"
#include "texture.h"
#include "tsdf.h"
#include "viewer.h"
#endif
#include "mesh_tile.h"
#include "shading.h"
#include "splat_order_tile.h"
#include "splat_tile.h"
#include "ssim.h"
#include "stereo.h"

#if defined(_WIN32)
#define MS_EXPORT __declspec(dllexport)
#else
#define MS_EXPORT __attribute__((visibility("default")))
#endif

namespace {

// Calls render(worker, tile, list, length) for every tile, with one worker per thread; returns the number of
// fragments blended.
template <class MakeWorker, class Render>
int64_t render_tiles(const ms::Grid &grid, const std::vector<ms::BinItem> &items, int threads,
                     MakeWorker make_worker, Render render) {
    threads = (int)std::min<int64_t>(threads, grid.tiles());
    std::vector<decltype(make_worker())> workers(threads);
    ms::TileLists lists(grid, items, threads);
    while (lists.next()) {
        std::atomic<int64_t> next{lists.begin()};
        ms::on_threads(threads, [&](int thread) {
            if (!workers[thread]) workers[thread] = make_worker();
            for (int64_t tile; (tile = next.fetch_add(1)) < lists.end();) {
                ms::stop_point();
                render(*workers[thread], tile, lists.list(tile), lists.length(tile));
            }
        });
    }
    int64_t fragments = 0;
    for (auto &worker : workers)
        if (worker) fragments += worker->fragments();
    return fragments;
}

// `more`: what else the worker's render() takes; its result is returned.
template <class Worker, class... More>
auto render_tile(const ms::Grid &grid, Worker &worker, int64_t tile, const ms::TileEntry *list,
                 int64_t length, More &&...more) {
    int x, y;
    grid.tile_position(tile, x, y);
    return worker.render(x, y, list, length, more...);
}

ms::Grid mesh_grid(const MsMesh &mesh, const MsCamera &camera, const MsOptions &options) {
    return ms::Grid(camera, options.samples, mesh.by_splat ? ms::LARGE_TILE : ms::TILE);
}

// Forward pass by tiles of one class; records on `tape` if it is not null.
template <class Tile>
int64_t render_mesh_tiles(const ms::Scene &scene, const ms::Grid &grid, const MsCamera &camera,
                          const MsOptions &options, const MsImage &image, ms::Tape *tape) {
    return render_tiles(
        grid, scene.items, options.threads,
        [&] {
            auto worker = std::make_unique<Tile>(scene, ms::ImageTile(scene, options, image, camera));
            if (tape) worker->record_tape();
            return worker;
        },
        [&](Tile &worker, int64_t tile, const ms::TileEntry *list, int64_t length) {
            render_tile(grid, worker, tile, list, length);
            if (tape)
                tape->record(tile, [&](ms::PackedTape &packed, auto allocate) {
                    return worker.image().pack_tape(packed, allocate);
                });
        });
}

int64_t render_mesh(const ms::Scene &scene, const ms::Grid &grid, const MsCamera &camera,
                    const MsOptions &options, const MsImage &image, ms::Tape *tape) {
    if (scene.mesh.by_splat)
        return render_mesh_tiles<ms::SplatOrderTile>(scene, grid, camera, options, image, tape);
    return render_mesh_tiles<ms::MeshTile>(scene, grid, camera, options, image, tape);
}

// The results of the forward pass that the backward pass needs.
struct ForwardRecord {
    ms::Tape tape;
    std::unique_ptr<ms::FanFilter> filter;  // or null
};

// The backward pass of all tiles. Tiles whose tapes exceeded the budget are rendered again.
class BackwardPass {
  public:
    BackwardPass(const MsMesh &mesh, const MsCamera &camera, const MsOptions &options,
                 const ForwardRecord &record, const MsImageGradients &image_gradients,
                 const MsVertexGradients &out)
        : camera_(camera),
          options_(options),
          tape_(record.tape),
          filter_(record.filter.get()),
          image_gradients_(image_gradients),
          out_(out),
          grid_(mesh_grid(mesh, camera, options)),
          scene_(mesh, camera, grid_, options.threads, !tape_.complete(), filter_),
          threads_((int)std::min<int64_t>(options.threads, grid_.tiles())),
          filtered_positions_(filter_ ? 3 * mesh.vertex_count : 0),
          tile_target_{filter_ ? filtered_positions_.data() : out.vertices, out.colors, out.attributes},
          sum_(mesh, tile_target_, image_gradients.attributes ? mesh.attribute_count : 0, threads_),
          wave_(WAVE),
          workers_(threads_) {}

    void run() {
        if (tape_.complete()) {
            run_tiles(0, grid_.tiles(), nullptr);
        } else {
            ms::TileLists lists(grid_, scene_.items, threads_);
            while (lists.next()) run_tiles(lists.begin(), lists.end(), &lists);
        }
        if (filter_) filter_->backward(filtered_positions_.data(), out_, options_.threads);
    }

  private:
    // Tile gradients wait to be added in order. A wave of tiles is short enough for their memory to stay
    // small, and long enough for threads not to wait for each other.
    static constexpr int WAVE = 256;                             // tiles
    static constexpr int64_t WAVE_TRIANGLES = (int64_t)1 << 17;  // per thread

    struct Worker {
        ms::GradientTile gradient;
        // To render tiles again, one of them:
        std::unique_ptr<ms::MeshTile> by_fragment;
        std::unique_ptr<ms::SplatOrderTile> by_splat;
        ms::PackedTape tape;  // of such a tile
        ms::PooledVector<unsigned char> tape_memory;
    };

    // The tiles [begin, end). `lists` are their tile lists, or null if all of them have tapes.
    void run_tiles(int64_t begin, int64_t end, ms::TileLists *lists) {
        while (begin < end) {
            const int count = wave_size(begin, end, lists);
            std::atomic<int> next{0};
            ms::on_threads(threads_, [&](int thread) {
                auto &worker = workers_[thread];
                if (!worker)
                    worker.reset(new Worker{ms::GradientTile(scene_, options_, camera_, image_gradients_),
                                            nullptr,
                                            nullptr,
                                            {},
                                            {}});
                for (int i; (i = next.fetch_add(1)) < count;) {
                    ms::stop_point();
                    const int64_t tile = begin + i;
                    const ms::PackedTape *tape = tape_.find(tile);
                    if (!tape) tape = &render_again(*worker, tile, *lists);
                    int x, y;
                    grid_.tile_position(tile, x, y);
                    worker->gradient.backward(x, y, *tape, wave_[i]);
                }
            });
            sum_.add(wave_.data(), count);
            begin += count;
        }
    }

    // Number of tiles from `begin` on whose gradients are added together, at least 1.
    int wave_size(int64_t begin, int64_t end, const ms::TileLists *lists) const {
        int count = 0;
        for (int64_t triangles = 0; count < WAVE && begin + count < end &&
                                    (count < threads_ || triangles < threads_ * WAVE_TRIANGLES);
             ++count) {
            const ms::PackedTape *tape = tape_.find(begin + count);
            triangles += tape ? (int64_t)tape->face_count() : lists->length(begin + count);
        }
        return count;
    }

    const ms::PackedTape &render_again(Worker &worker, int64_t tile, const ms::TileLists &lists) const {
        return scene_.mesh.by_splat ? render_again(worker.by_splat, worker, tile, lists)
                                    : render_again(worker.by_fragment, worker, tile, lists);
    }

    template <class Tile>
    const ms::PackedTape &render_again(std::unique_ptr<Tile> &forward, Worker &worker, int64_t tile,
                                       const ms::TileLists &lists) const {
        if (!forward) {
            forward = std::make_unique<Tile>(scene_, ms::ImageTile(scene_, options_, no_image_, camera_));
            forward->record_tape();
        }
        render_tile(grid_, *forward, tile, lists.list(tile), lists.length(tile));
        forward->image().pack_tape(worker.tape, [&](size_t bytes) {
            worker.tape_memory.resize(bytes);
            return worker.tape_memory.data();
        });
        return worker.tape;
    }

    const MsCamera &camera_;
    const MsOptions &options_;
    const ms::Tape &tape_;
    const ms::FanFilter *filter_;  // or null
    const MsImageGradients &image_gradients_;
    const MsVertexGradients &out_;
    const MsImage no_image_{};
    const ms::Grid grid_;
    const ms::Scene scene_;
    const int threads_;
    std::vector<float> filtered_positions_;  // gradients in camera space, if there is a filter
    const MsVertexGradients tile_target_;    // where the gradients of tiles are added
    ms::VertexGradients sum_;
    std::vector<ms::TileGradients> wave_;
    std::vector<std::unique_ptr<Worker>> workers_;
};

enum Status { OK = 0, OUT_OF_MEMORY = 1, FAILED = 2, SHARED_VERTICES = 3, STOPPED = 4 };

// Turns exceptions into a status and a message.
template <class Body>
int guarded(char *message, int size, Body body) {
    try {
        body();
        return OK;
    } catch (const std::bad_alloc &) {
        std::snprintf(message, size, "not enough memory");
        return OUT_OF_MEMORY;
    } catch (const ms::SharedVertices &e) {
        std::snprintf(message, size, "%s", e.what());
        return SHARED_VERTICES;
    } catch (const ms::Stopped &e) {
        std::snprintf(message, size, "%s", e.what());
        return STOPPED;
    } catch (const std::exception &e) {
        std::snprintf(message, size, "%s", e.what());
        return FAILED;
    }
}

}  // namespace

extern "C" {

// Raise it with every change of a structure or function.
MS_EXPORT int ms_interface_version() { return 17; }

// The fields of all structures of this library, and how many they are.
MS_EXPORT const MsField *ms_layout(int32_t *count) {
    *count = (int32_t)std::size(ms::FIELDS);
    return ms::FIELDS;
}

MS_EXPORT const char *ms_variant() { return MS_VARIANT; }

// The best variant that this processor runs.
MS_EXPORT const char *ms_best_variant() {
#if defined(__x86_64__)
    const int level = ms::x86_64_level();
    if (level >= 3) return level >= 4 ? "v4" : "v3";
#endif
    return "baseline";
}

// Calls that this thread makes from now on end soon after `flag` is not 0 any more, with results of no use.
MS_EXPORT void ms_stop_with(const int32_t *flag) { ms::stop_flag = flag; }

// All functions below return a Status and, unless it is OK, write a message of at most message_size bytes.

MS_EXPORT int ms_render_mesh(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                             MsImage *image, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        const ms::Grid grid = mesh_grid(*mesh, *camera, *options);
        ms::Scene scene(*mesh, *camera, grid, options->threads);
        image->fragments = render_mesh(scene, grid, *camera, *options, *image, nullptr);
    });
}

// Like ms_render_mesh, and records a tape of at most `budget` bytes for ms_rasterize_backward. Release it
// with ms_free_tape. The arrays of the mesh must not change or move in between.
MS_EXPORT int ms_rasterize(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                           MsImage *image, int64_t budget, void **tape, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        const ms::Grid grid = mesh_grid(*mesh, *camera, *options);
        ms::Scene scene(*mesh, *camera, grid, options->threads);
        std::unique_ptr<ForwardRecord> record(new ForwardRecord{{grid.tiles(), budget}, nullptr});
        image->fragments = render_mesh(scene, grid, *camera, *options, *image, &record->tape);
        record->filter = std::move(scene.filter);
        *tape = record.release();
    });
}

// Adds the gradients of the vertices to `out`. Mesh, camera and options must be those of ms_rasterize.
MS_EXPORT int ms_rasterize_backward(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                                    const void *tape, const MsImageGradients *image_gradients,
                                    const MsVertexGradients *out, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        BackwardPass(*mesh, *camera, *options, *(const ForwardRecord *)tape, *image_gradients, *out).run();
    });
}

MS_EXPORT void ms_free_tape(void *tape) { delete (ForwardRecord *)tape; }

MS_EXPORT int ms_render_splats(const MsSplats *splats, const MsCamera *camera, const MsOptions *options,
                               MsImage *image, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::SplatScene scene(*splats, *camera, grid, options->threads);
        ms::OpenTiles open(grid);
        std::vector<std::unique_ptr<ms::SplatSums>> left(grid.tiles());
        image->fragments = 0;
        for (int stage = 0; stage < scene.stages(); ++stage) {
            scene.begin(stage, open);
            image->fragments += render_tiles(
                grid, scene.items, options->threads,
                [&] {
                    return std::make_unique<ms::SplatTile>(scene, grid, *options, *image, *camera, *splats);
                },
                [&](ms::SplatTile &worker, int64_t tile, const ms::TileEntry *list, int64_t length) {
                    if (!open.is_open(tile)) return;
                    const bool last = stage == scene.stages() - 1;
                    if (render_tile(grid, worker, tile, list, length, last, left[tile])) open.close(tile);
                });
            open.count();
        }
    });
}

MS_EXPORT int ms_compare_images(MsComparison *comparison, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::compare_images(*comparison); });
}

MS_EXPORT int ms_adam_rows(const MsAdam *adam, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::adam_rows(*adam); });
}

MS_EXPORT int ms_round_fans(const MsFans *fans, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::round_fans(*fans); });
}

MS_EXPORT int ms_edge_gradients(const MsEdges *edges, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::EdgePass(*edges).run(); });
}

MS_EXPORT int ms_shade(const MsShading *shading, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::Shading(*shading).forward(); });
}

MS_EXPORT int ms_shade_backward(const MsShading *shading, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::Shading(*shading).backward(); });
}

MS_EXPORT int ms_match_photos(const MsMatching *matching, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::Matching(*matching).run(); });
}

#ifndef MS_WIDE_ONLY
MS_EXPORT int ms_fuse_depth(const MsFusing *fusing, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::fuse_depth(*fusing); });
}

MS_EXPORT int ms_texture(const MsTexture *texture, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::TexturePass(*texture).forward(); });
}

MS_EXPORT int ms_texture_backward(const MsTexture *texture, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::TexturePass(*texture).backward(); });
}

MS_EXPORT int ms_nearest(const MsNearest *points, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::find_nearest(*points); });
}

MS_EXPORT int ms_merge_pairs(MsMerging *merging, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::merge_pairs(*merging); });
}

MS_EXPORT int ms_viewer_images(const MsViewer *viewer, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::ViewerPass(*viewer).run(); });
}

MS_EXPORT int ms_order_triangles(MsOrdering *ordering, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::Ordering(*ordering).run(); });
}

MS_EXPORT int ms_list_triangles(const MsListing *listing, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::Listing(*listing).run(); });
}

MS_EXPORT int ms_count_consistent(const MsConsistency *consistency, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::count_consistent(*consistency); });
}

MS_EXPORT int ms_fill_depths(const MsFilling *filling, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::fill_depths(*filling); });
}

MS_EXPORT int ms_count_views(const MsCarving *carving, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::count_views(*carving); });
}

MS_EXPORT int ms_nearest_vertices(const MsNearestVertices *places, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::nearest_vertices(*places); });
}

MS_EXPORT int ms_sum_cells(const MsCellSums *sums, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::sum_cells(*sums); });
}

MS_EXPORT int ms_resample(const MsResampling *resampling, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::resample(*resampling); });
}

MS_EXPORT int ms_fuse_points(MsFusion *fusion, char *message, int message_size) {
    return guarded(message, message_size, [&] { fusion->found = ms::Fusion(*fusion).run(); });
}
#endif

}  // extern "C"
