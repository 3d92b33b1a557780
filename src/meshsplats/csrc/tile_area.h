// The samples of a tile: blocks of 4 x 4 samples, one SIMD lane per sample. A quadrant is 4 x 4 blocks, a
// large tile 2 x 2 quadrants.
#pragma once

#include "grid.h"
#include "lanes.h"

namespace ms {

// Sample index in a tile: 16 block + 4 row + column, so that a block is contiguous. Block index: 16 quadrant
// + 4 row + column.
constexpr int QUADRANT_BLOCKS = TILE * TILE / LANES, MAX_QUADRANTS = 4;
constexpr int MAX_BLOCKS = MAX_QUADRANTS * QUADRANT_BLOCKS, MAX_SAMPLES = MAX_BLOCKS * LANES;
static_assert(LARGE_TILE == 2 * TILE);

struct TileArea {
    int x0, y0;         // first sample of the tile
    int columns, rows;  // size in samples, clipped to the image
    int blocks;         // of the tile, those outside the image included

    TileArea() = default;
    TileArea(const Grid &grid, int tile_x, int tile_y)
        : x0(tile_x * grid.tile_side),
          y0(tile_y * grid.tile_side),
          columns(std::min(grid.tile_side, grid.width - x0)),
          rows(std::min(grid.tile_side, grid.height - y0)),
          blocks((grid.largest_side == TILE ? 1 : MAX_QUADRANTS) * QUADRANT_BLOCKS) {
        MS_ASSERT(columns > 0 && columns <= grid.tile_side && rows > 0 && rows <= grid.tile_side);
    }

    // Between sample indices and columns and rows of the tile.
    static int sample_index(int x, int y) {
        const int quadrant = y / TILE * 2 + x / TILE, block = y % TILE / 4 * 4 + x % TILE / 4;
        return (quadrant * QUADRANT_BLOCKS + block) * LANES + y % 4 * 4 + x % 4;
    }
    static int column(int sample) { return (int)block_x(sample / LANES) + sample % 4; }
    static int row(int sample) { return (int)block_y(sample / LANES) + sample / 4 % 4; }

    // Corner of a block, relative to the tile.
    static float block_x(int block) { return 4.0f * (block % 4) + TILE * (block / QUADRANT_BLOCKS % 2); }
    static float block_y(int block) { return 4.0f * (block / 4 % 4) + TILE * (block / QUADRANT_BLOCKS / 2); }
    // The corners of the blocks of the first quadrant, one lane per block.
    static Lanes blocks_x() {
        alignas(64) static const float x[QUADRANT_BLOCKS] = {0, 4, 8, 12, 0, 4, 8, 12,
                                                             0, 4, 8, 12, 0, 4, 8, 12};
        return load_lanes(x);
    }
    static Lanes blocks_y() {
        alignas(64) static const float y[QUADRANT_BLOCKS] = {0, 0, 0, 0, 4,  4,  4,  4,
                                                             8, 8, 8, 8, 12, 12, 12, 12};
        return load_lanes(y);
    }
    // Sample centres relative to the corner of their block, one lane per sample.
    static Lanes samples_x() {
        alignas(64) static const float x[LANES] = {.5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5,
                                                   .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5};
        return load_lanes(x);
    }
    static Lanes samples_y() {
        alignas(64) static const float y[LANES] = {.5,  .5,  .5,  .5,  1.5, 1.5, 1.5, 1.5,
                                                   2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};
        return load_lanes(y);
    }

    // The lanes of a block that lie inside the image.
    LaneMask valid_lanes(int block) const {
        LaneMask valid = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            int sample = block * LANES + lane;
            if (column(sample) < columns && row(sample) < rows) valid |= 1u << lane;
        }
        return valid;
    }
};

}  // namespace ms
