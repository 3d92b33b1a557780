// The plain C interface of the core: checks, memory and Python stay outside (rendering/core.py).
#include <cstdio>
#include <memory>
#include <new>

#include "adam.h"
#include "gradient.h"
#include "merging.h"
#include "mesh_tile.h"
#include "splats.h"
#include "ssim.h"

#if defined(_WIN32)
#define MS_EXPORT __declspec(dllexport)
#else
#define MS_EXPORT __attribute__((visibility("default")))
#endif

namespace {

// Calls draw(worker, tile, list, length) for every tile, with one worker a thread; returns the number of
// fragments blended.
template <class MakeWorker, class Draw>
int64_t draw_tiles(const ms::Grid &grid, const std::vector<ms::Item> &items, int threads,
                   MakeWorker make_worker, Draw draw) {
    threads = (int)std::min<int64_t>(threads, grid.tiles());
    std::vector<decltype(make_worker())> workers(threads);
    ms::TileLists lists(grid, items, threads);
    while (lists.next()) {
        std::atomic<int64_t> next{lists.begin()};
        ms::on_threads(threads, [&](int thread) {
            if (!workers[thread]) workers[thread] = make_worker();
            for (int64_t tile; (tile = next.fetch_add(1)) < lists.end();)
                draw(*workers[thread], tile, lists.list(tile), lists.length(tile));
        });
    }
    int64_t fragments = 0;
    for (auto &worker : workers)
        if (worker) fragments += worker->fragments();
    return fragments;
}

template <class Worker>
void draw_tile(const ms::Grid &grid, Worker &worker, int64_t tile, const ms::Entry *list, int64_t length) {
    int x, y;
    grid.place(tile, x, y);
    worker.draw(x, y, list, length);
}

using PictureWorker = ms::MeshTile<ms::PictureTile>;

int64_t draw_mesh(const ms::Scene &scene, const ms::Grid &grid, const MsCamera &camera,
                  const MsOptions &options, const MsPicture &picture, ms::PictureLog *log) {
    return draw_tiles(
        grid, scene.items, options.threads,
        [&] {
            auto worker =
                std::make_unique<PictureWorker>(scene, ms::PictureTile(scene, options, picture, camera));
            if (log) worker->blend().record();
            return worker;
        },
        [&](PictureWorker &worker, int64_t tile, const ms::Entry *list, int64_t length) {
            draw_tile(grid, worker, tile, list, length);
            if (log) log->keep(tile, worker.blend().log(), *worker.blend().pieces());
        });
}

// What the way back needs.
struct Record {
    ms::PictureLog log;
    std::unique_ptr<ms::FanFilter> filter;  // or none
};

// Goes back through all tiles: those with a log follow it, others are drawn once more.
void go_back(const MsMesh &mesh, const MsCamera &camera, const MsOptions &options, const Record &record,
             const MsPictureGradient &given, const MsVertexGradients &out) {
    const ms::PictureLog &log = record.log;
    const ms::FanFilter *filter = record.filter.get();
    const ms::Grid grid(camera, options.samples);
    const bool redraws = !log.complete();
    const ms::Scene scene(mesh, camera, grid, options.threads, redraws, filter);
    const int threads = (int)std::min<int64_t>(options.threads, grid.tiles());
    const int channels = given.attributes ? mesh.attribute_count : 0;
    const MsPicture nothing{};  // what is drawn once more is only logged
    std::vector<float> moved(filter ? 3 * mesh.vertex_count : 0);
    const MsVertexGradients of_drawn{filter ? moved.data() : out.vertices, out.colors, out.attributes};
    ms::VertexGradients sum(mesh, of_drawn, channels, threads);

    // Gradients of a few tiles at a time wait to be added in order: of so few that they need little memory,
    // but enough for threads not to wait for each other.
    constexpr int WAVE = 256;
    const int64_t wave_triangles = (int64_t)threads << 17;
    std::vector<ms::TileGradients> waiting(WAVE);
    struct Worker {
        ms::GradientTile back;
        std::unique_ptr<PictureWorker> again;
        ms::PackedLog packed;
        ms::Large<unsigned char> memory;  // of that
    };
    std::vector<std::unique_ptr<Worker>> workers(threads);
    auto run = [&](int64_t begin, int64_t end, ms::TileLists *lists) {
        for (int64_t wave = begin; wave < end;) {
            int count = 0;
            for (int64_t triangles = 0;
                 count < WAVE && wave + count < end && (count < threads || triangles < wave_triangles);
                 ++count) {
                const ms::PackedLog *entries = log.find(wave + count);
                triangles += entries ? (int64_t)entries->face_count() : lists->length(wave + count);
            }
            std::atomic<int> next{0};
            ms::on_threads(threads, [&](int thread) {
                auto &worker = workers[thread];
                if (!worker)
                    worker.reset(
                        new Worker{ms::GradientTile(scene, options, camera, given), nullptr, {}, {}});
                for (int i; (i = next.fetch_add(1)) < count;) {
                    const int64_t tile = wave + i;
                    const ms::PackedLog *entries = log.find(tile);
                    if (!entries) {
                        if (!worker->again) {
                            worker->again = std::make_unique<PictureWorker>(
                                scene, ms::PictureTile(scene, options, nothing, camera));
                            worker->again->blend().record();
                        }
                        draw_tile(grid, *worker->again, tile, lists->list(tile), lists->length(tile));
                        worker->packed.pack(worker->again->blend().log(), *worker->again->blend().pieces(),
                                            [&](size_t bytes) {
                                                worker->memory.resize(bytes);
                                                return worker->memory.data();
                                            });
                        entries = &worker->packed;
                    }
                    int x, y;
                    grid.place(tile, x, y);
                    worker->back.run(x, y, *entries, waiting[i]);
                }
            });
            sum.add(waiting.data(), count);
            wave += count;
        }
    };
    if (redraws) {
        ms::TileLists lists(grid, scene.items, threads);
        while (lists.next()) run(lists.begin(), lists.end(), &lists);
    } else {
        run(0, grid.tiles(), nullptr);
    }
    if (filter) filter->back(moved.data(), out, options.threads);
}

template <class Body>
int guarded(char *message, int size, Body body) {
    try {
        body();
        return 0;
    } catch (const std::bad_alloc &) {
        std::snprintf(message, size, "not enough memory");
        return 1;
    } catch (const ms::SharedVertices &e) {
        std::snprintf(message, size, "%s", e.what());
        return 3;
    } catch (const std::exception &e) {
        std::snprintf(message, size, "%s", e.what());
        return 2;
    }
}

}  // namespace

extern "C" {

MS_EXPORT int ms_interface_version() { return 3; }

MS_EXPORT const char *ms_variant() { return MS_VARIANT; }

// The best variant this processor runs.
MS_EXPORT const char *ms_best_variant() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        return "v4";
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
        __builtin_cpu_supports("bmi2"))
        return "v3";
#endif
    return "baseline";
}

// All functions from here on return 0, or 1 (memory), 3 (splats that share vertices cannot be filtered) or 2
// (other) with a message.
MS_EXPORT int ms_render_mesh(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                             MsPicture *picture, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::Scene scene(*mesh, *camera, grid, options->threads);
        picture->fragments = draw_mesh(scene, grid, *camera, *options, *picture, nullptr);
    });
}

// The same, with a log of at most `budget` bytes to go back by, which ms_forget frees.
MS_EXPORT int ms_rasterize(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                           MsPicture *picture, int64_t budget, void **log, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::Scene scene(*mesh, *camera, grid, options->threads);
        std::unique_ptr<Record> kept(new Record{{grid.tiles(), budget}, nullptr});
        picture->fragments = draw_mesh(scene, grid, *camera, *options, *picture, &kept->log);
        kept->filter = std::move(scene.filter);
        *log = kept.release();
    });
}

MS_EXPORT int ms_rasterize_back(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options,
                                const void *log, const MsPictureGradient *given, const MsVertexGradients *out,
                                char *message, int message_size) {
    return guarded(message, message_size,
                   [&] { go_back(*mesh, *camera, *options, *(const Record *)log, *given, *out); });
}

MS_EXPORT void ms_forget(void *log) { delete (Record *)log; }

MS_EXPORT int ms_render_splats(const MsSplats *splats, const MsCamera *camera, const MsOptions *options,
                               MsPicture *picture, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::SplatScene scene(*splats, *camera, grid, options->threads);
        picture->fragments = draw_tiles(
            grid, scene.items, options->threads,
            [&] {
                return std::make_unique<ms::SplatTile>(scene, grid, *options, *picture, *camera, *splats);
            },
            [&](ms::SplatTile &worker, int64_t tile, const ms::Entry *list, int64_t length) {
                draw_tile(grid, worker, tile, list, length);
            });
    });
}

MS_EXPORT int ms_compare_pictures(MsComparison *comparison, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::compare_pictures(*comparison); });
}

MS_EXPORT int ms_adam_rows(const MsAdam *adam, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::adam_rows(*adam); });
}

MS_EXPORT int ms_nearest(const MsNearest *points, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::find_nearest(*points); });
}

MS_EXPORT int ms_merge_pairs(MsMerging *merging, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::merge_pairs(*merging); });
}

}  // extern "C"
