// The samples of a tile.
#pragma once

#include "grid.h"
#include "lanes.h"

namespace ms {

// Samples are numbered by blocks of 4 x 4: sample = 16 block + 4 row + column.
constexpr int SAMPLES = TILE * TILE, BLOCKS = SAMPLES / LANES;

struct TileArea {
    int x0, y0, columns, rows;  // in samples; columns and rows are those on the picture

    TileArea() = default;
    TileArea(const Grid &grid, int tile_x, int tile_y)
        : x0(tile_x * grid.side),
          y0(tile_y * grid.side),
          columns(std::min(grid.side, grid.width - x0)),
          rows(std::min(grid.side, grid.height - y0)) {}

    static int number(int x, int y) { return (y / 4 * 4 + x / 4) * LANES + y % 4 * 4 + x % 4; }
    static int column(int sample) { return sample / LANES % 4 * 4 + sample % 4; }
    static int row(int sample) { return sample / (4 * LANES) * 4 + sample / 4 % 4; }

    // Corner of a block.
    static float block_x(int block) { return 4.0f * (block % 4); }
    static float block_y(int block) { return 4.0f * (block / 4); }
    // Of all blocks.
    static Lanes blocks_x() {
        alignas(64) static const float x[BLOCKS] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
        return load_lanes(x);
    }
    static Lanes blocks_y() {
        alignas(64) static const float y[BLOCKS] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};
        return load_lanes(y);
    }
    // Its samples, from that corner.
    static Lanes lane_x() {
        alignas(64) static const float x[LANES] = {.5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5,
                                                   .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5};
        return load_lanes(x);
    }
    static Lanes lane_y() {
        alignas(64) static const float y[LANES] = {.5,  .5,  .5,  .5,  1.5, 1.5, 1.5, 1.5,
                                                   2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};
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
};

}  // namespace ms
