// The samples of a tile, and the values of its triangles there.
#pragma once

#include "grid.h"
#include "waiting.h"

namespace ms {

// Samples are numbered by blocks of 4 x 4: sample = 16 block + 4 row + column.
constexpr int SAMPLES = TILE * TILE, BLOCKS = SAMPLES / LANES;

struct TileArea {
    int x0, y0, columns, rows;  // in samples; columns and rows are those on the picture

    TileArea() = default;
    TileArea(const Grid &grid, int tile_x, int tile_y)
        : x0(tile_x * grid.side), y0(tile_y * grid.side), columns(std::min(grid.side, grid.width - x0)),
          rows(std::min(grid.side, grid.height - y0)) {}

    static int number(int x, int y) { return (y / 4 * 4 + x / 4) * LANES + y % 4 * 4 + x % 4; }
    static int column(int sample) { return sample / LANES % 4 * 4 + sample % 4; }
    static int row(int sample) { return sample / (4 * LANES) * 4 + sample / 4 % 4; }

    // Corner of a block.
    static float block_x(int block) { return 4.0f * (block % 4); }
    static float block_y(int block) { return 4.0f * (block / 4); }
    // Its samples, from that corner.
    static Lanes lane_x() {
        alignas(64) static const float x[LANES] = {.5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5};
        return load_lanes(x);
    }
    static Lanes lane_y() {
        alignas(64) static const float y[LANES] = {.5, .5, .5, .5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};
        return load_lanes(y);
    }

    // The samples of a block that are on the picture.
    uint32_t lanes(int block) const {
        uint32_t bits = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            int sample = block * LANES + lane;
            if (column(sample) < columns && row(sample) < rows) bits |= 1u << lane;
        }
        return bits;
    }

    // Depth of a triangle at the samples of a block, where its keys are `key`; positive and finite everywhere.
    static Lanes depth(const TileTriangle &t, int block, const Lanes &key) {
        if (t.keys_are_depths) return ms::lanes(1) / key;
        const float corner = t.qa * block_x(block) + (t.qb * block_y(block) + t.qc);
        const Lanes q = (ms::lanes(t.qa) * lane_x() + ms::lanes(t.qb) * lane_y()) + ms::lanes(corner);
        return ms::lanes(1) / clamp(q, ms::lanes(t.q_min), ms::lanes(t.q_max));
    }

    // RGBA of a triangle at the samples of a block, where its depth is z.
    static void values(const TileTriangle &t, int block, const Lanes &z, Lanes rgba[4]) {
        alignas(16) float corner[4];
        store4(corner, load4(t.a) * set4(block_x(block)) + (load4(t.b) * set4(block_y(block)) + load4(t.c)));
        const Lanes x = lane_x(), y = lane_y();
        for (int i = 0; i < 4; ++i) {
            const Lanes linear = (ms::lanes(t.a[i]) * x + ms::lanes(t.b[i]) * y) + ms::lanes(corner[i]);
            rgba[i] = clamp(linear * z, ms::lanes(t.low[i]), ms::lanes(t.high[i]));
        }
    }
};

}  // namespace ms
