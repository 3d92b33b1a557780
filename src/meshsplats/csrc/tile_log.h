// What was blended in a tile, in order: enough to go through its fragments again without finding or sorting them.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "tile_area.h"

namespace ms {

struct TileLog {
    // The samples of one block that a triangle covers.
    struct Piece {
        uint32_t triangle;  // which one of `faces`
        uint32_t lanes;
    };
    // Samples of a block that take their fragments of some pieces; no two of these share a sample.
    struct Step {
        uint32_t first;  // of `pieces`
        uint16_t lanes, count;
    };
    std::vector<int32_t> faces;
    std::vector<Piece> pieces;
    std::vector<Step> steps[BLOCKS];  // at every sample nearest first

    void clear() {
        faces.clear();
        pieces.clear();
        for (auto &block : steps) block.clear();
    }

    // Calls call(triangle, lanes) for the pieces that have some of the lanes.
    template <class Call>
    void for_pieces(uint32_t first, uint32_t count, uint32_t lanes, Call &&call) const {
        for (uint32_t i = first; i < first + count; ++i)
            if (const uint32_t part = pieces[i].lanes & lanes) call(pieces[i].triangle, part);
    }
};

// The same, no larger than it must be.
struct PackedLog {
    std::vector<int32_t> faces;
    std::vector<TileLog::Piece> pieces;
    std::vector<TileLog::Step> steps;
    uint32_t end[BLOCKS];  // of each block's steps

    static int64_t bytes(const TileLog &log) {
        int64_t sum = (int64_t)(log.faces.size() * sizeof(int32_t) + log.pieces.size() * sizeof(TileLog::Piece));
        for (auto &block : log.steps) sum += (int64_t)(block.size() * sizeof(TileLog::Step));
        return sum;
    }

    void pack(const TileLog &log) {
        faces = log.faces;  // a copy is as large as what it holds
        pieces = log.pieces;
        size_t sum = 0;
        for (auto &block : log.steps) sum += block.size();
        steps.clear();
        steps.reserve(sum);
        for (int block = 0; block < BLOCKS; ++block) {
            steps.insert(steps.end(), log.steps[block].begin(), log.steps[block].end());
            end[block] = (uint32_t)steps.size();
        }
    }
};

// The logs of a picture's tiles, as far as they fit a budget of memory; other tiles have to be drawn again.
class PictureLog {
  public:
    PictureLog(int64_t tiles, int64_t budget) : tiles_(tiles), left_(budget) {}

    // Not for one tile by two threads.
    void keep(int64_t tile, const TileLog &log) {
        const int64_t bytes = PackedLog::bytes(log);
        if (left_.fetch_sub(bytes) < bytes) {
            left_.fetch_add(bytes);
            return;
        }
        tiles_[tile] = std::make_unique<PackedLog>();
        tiles_[tile]->pack(log);
    }
    const PackedLog *find(int64_t tile) const { return tiles_[tile].get(); }
    bool complete() const {
        for (auto &tile : tiles_)
            if (!tile) return false;
        return true;
    }

  private:
    std::vector<std::unique_ptr<PackedLog>> tiles_;
    std::atomic<int64_t> left_;
};

}  // namespace ms
