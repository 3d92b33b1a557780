// The plain C interface of the core: checks, memory and Python stay outside (rendering/core.py).
#include <cstdio>
#include <new>

#include "adam.h"
#include "mesh_tile.h"
#include "splats.h"
#include "ssim.h"

#if defined(_WIN32)
#define MS_EXPORT __declspec(dllexport)
#else
#define MS_EXPORT __attribute__((visibility("default")))
#endif

namespace {

// Draws every tile with one `Tile` a thread; returns the number of fragments blended.
template <class MakeTile>
int64_t draw_tiles(const ms::Grid &grid, const std::vector<ms::Item> &items, int threads, MakeTile make_tile) {
    threads = (int)std::min<int64_t>(threads, grid.tiles());
    std::vector<decltype(make_tile())> workers(threads);
    ms::TileLists lists(grid, items, threads);
    while (lists.next()) {
        std::atomic<int64_t> next{lists.begin()};
        ms::on_threads(threads, [&](int thread) {
            if (!workers[thread]) workers[thread] = make_tile();
            for (int64_t tile; (tile = next.fetch_add(1)) < lists.end();)
                workers[thread]->draw((int)(tile % grid.tiles_x), (int)(tile / grid.tiles_x), lists.list(tile),
                                      lists.length(tile));
        });
    }
    int64_t fragments = 0;
    for (auto &worker : workers)
        if (worker) fragments += worker->fragments();
    return fragments;
}

template <class Body>
int guarded(char *message, int size, Body body) {
    try {
        body();
        return 0;
    } catch (const std::bad_alloc &) {
        std::snprintf(message, size, "not enough memory");
        return 1;
    } catch (const std::exception &e) {
        std::snprintf(message, size, "%s", e.what());
        return 2;
    }
}

}  // namespace

extern "C" {

MS_EXPORT int ms_interface_version() { return 1; }

MS_EXPORT const char *ms_variant() { return MS_VARIANT; }

// The best variant this processor runs.
MS_EXPORT const char *ms_best_variant() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        return "v4";
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
        __builtin_cpu_supports("bmi2"))
        return "v3";
#endif
    return "baseline";
}

// Returns 0, or 1 (memory) or 2 (other) with a message.
MS_EXPORT int ms_render_mesh(const MsMesh *mesh, const MsCamera *camera, const MsOptions *options, MsPicture *picture,
                             char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::Scene scene(*mesh, *camera, grid, options->threads);
        picture->fragments = draw_tiles(grid, scene.items, options->threads, [&] {
            return std::make_unique<ms::MeshTile>(scene, *options, *picture, *camera);
        });
    });
}

MS_EXPORT int ms_render_splats(const MsSplats *splats, const MsCamera *camera, const MsOptions *options,
                               MsPicture *picture, char *message, int message_size) {
    return guarded(message, message_size, [&] {
        ms::Grid grid(*camera, options->samples);
        ms::SplatScene scene(*splats, *camera, grid, options->threads);
        picture->fragments = draw_tiles(grid, scene.items, options->threads, [&] {
            return std::make_unique<ms::SplatTile>(scene, grid, *options, *picture, *camera, *splats);
        });
    });
}

MS_EXPORT int ms_compare_pictures(MsComparison *comparison, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::compare_pictures(*comparison); });
}

MS_EXPORT int ms_adam_rows(const MsAdam *adam, char *message, int message_size) {
    return guarded(message, message_size, [&] { ms::adam_rows(*adam); });
}

}  // extern "C"
