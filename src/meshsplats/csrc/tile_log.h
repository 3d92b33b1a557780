// What was blended in a tile, in order: enough to go through its fragments again without finding or sorting them.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

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
        uint16_t lanes;
        uint8_t count, block;
    };
    std::vector<int32_t> faces;
    std::vector<Piece> pieces;
    std::vector<Step> steps;  // at every sample nearest first

    void clear() {
        faces.clear();
        pieces.clear();
        steps.clear();
    }
    int64_t bytes() const {
        return (int64_t)(faces.size() * sizeof(int32_t) + pieces.size() * sizeof(Piece) + steps.size() * sizeof(Step));
    }

    // Calls call(triangle, lanes) for the pieces that have some of the lanes.
    template <class Call>
    void for_pieces(uint32_t first, uint32_t count, uint32_t lanes, Call &&call) const {
        for (uint32_t i = first; i < first + count; ++i)
            if (const uint32_t part = pieces[i].lanes & lanes) call(pieces[i].triangle, part);
    }
};

// The logs of a picture's tiles, as far as they fit a budget of memory; other tiles have to be drawn again.
class PictureLog {
  public:
    PictureLog(int64_t tiles, int64_t budget) : tiles_(tiles), left_(budget) {}

    // Not for one tile by two threads.
    void keep(int64_t tile, const TileLog &log) {
        const int64_t bytes = log.bytes();
        if (left_.fetch_sub(bytes) < bytes) {
            left_.fetch_add(bytes);
            return;
        }
        tiles_[tile] = std::make_unique<TileLog>(log);  // a copy is as large as what it holds
    }
    const TileLog *find(int64_t tile) const { return tiles_[tile].get(); }
    bool complete() const {
        for (auto &tile : tiles_)
            if (!tile) return false;
        return true;
    }

  private:
    std::vector<std::unique_ptr<TileLog>> tiles_;
    std::atomic<int64_t> left_;
};

}  // namespace ms
