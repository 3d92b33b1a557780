// What was blended in a tile, in order: enough to go through its fragments again without finding or sorting them.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

namespace ms {

struct TileLog {
    struct Entry {
        uint32_t triangle;  // which one of `faces`
        uint16_t lanes;     // samples of the block
        uint16_t block;
    };
    std::vector<int32_t> faces;
    std::vector<Entry> entries;  // at every sample nearest first

    void clear() {
        faces.clear();
        entries.clear();
    }
};

// The logs of a picture's tiles, as far as they fit a budget of memory; other tiles have to be drawn again.
class PictureLog {
  public:
    PictureLog(int64_t tiles, int64_t budget) : tiles_(tiles), left_(budget) {}

    // Not for one tile by two threads.
    void keep(int64_t tile, const TileLog &log) {
        const int64_t bytes = (int64_t)(log.faces.size() * sizeof(int32_t) + log.entries.size() * sizeof(TileLog::Entry));
        if (left_.fetch_sub(bytes) < bytes) {
            left_.fetch_add(bytes);
            return;
        }
        auto kept = std::make_unique<TileLog>();
        kept->faces = log.faces;  // copies are as large as what they hold
        kept->entries = log.entries;
        tiles_[tile] = std::move(kept);
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
