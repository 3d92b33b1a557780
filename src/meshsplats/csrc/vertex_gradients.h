// The vertex gradients of tiles, and their sum over an image.
#pragma once

#include "lanes.h"
#include "parallel.h"
#include "pooled_vector.h"
#include "types.h"

namespace ms {

// The vertex gradients of one tile. A vertex may occur more than once.
struct TileGradients {
    struct Sum {
        alignas(32) float position[4];  // camera or world space, see TapeTriangles; the last is padding
        float rgba[4];
    };
    // Vectors only grow: the first `count` elements are in use.
    PooledVector<int32_t> vertices;
    PooledVector<Sum> sums;
    PooledVector<float> attributes;  // (count, attribute_count)
    size_t count = 0;

    // Makes room to append `more` vertices.
    void reserve(size_t more, int channels) {
        if (vertices.size() >= count + more) return;
        vertices.resize(std::max(count + more, 2 * vertices.size()));
        sums.resize(vertices.size());
        attributes.resize(vertices.size() * channels);
    }
};

// Adds the gradients of tiles to those of the vertices, in the order of the tiles: the result does not depend
// on the number of threads.
class VertexGradients {
  public:
    VertexGradients(const MsMesh &mesh, const MsVertexGradients &out, int attribute_channels, int threads)
        : mesh_(mesh), out_(out), attribute_channels_(attribute_channels), threads_(threads) {}

    // Each thread goes through all tiles and adds its own range of vertices.
    void add(const TileGradients *tiles, int count) {
        on_threads(threads_, [&](int thread) {
            const int64_t begin = mesh_.vertex_count * thread / threads_,
                          end = mesh_.vertex_count * (thread + 1) / threads_;
            for (int i = 0; i < count; ++i) add_tile(tiles[i], begin, end);
        });
    }

  private:
    static constexpr size_t PREFETCH_AHEAD = 24;

    void add_tile(const TileGradients &tile, int64_t begin, int64_t end) {
        for (size_t i = 0; i < tile.count; ++i) {
            if (i + PREFETCH_AHEAD < tile.count) {
                const int64_t v = tile.vertices[i + PREFETCH_AHEAD];
                __builtin_prefetch(out_.vertices + 3 * v, 1);
                __builtin_prefetch(out_.colors + 4 * v, 1);
            }
            const int64_t v = tile.vertices[i];
            if (v < begin || v >= end) continue;
            const TileGradients::Sum &sum = tile.sums[i];
            for (int j = 0; j < 3; ++j) out_.vertices[3 * v + j] += sum.position[j];
            store4(out_.colors + 4 * v, load4(out_.colors + 4 * v) + load4(sum.rgba));
            for (int c = 0; c < attribute_channels_; ++c)
                out_.attributes[v * attribute_channels_ + c] += tile.attributes[i * attribute_channels_ + c];
        }
    }

    const MsMesh &mesh_;
    const MsVertexGradients &out_;
    int attribute_channels_, threads_;
};

}  // namespace ms
