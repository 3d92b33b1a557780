// What was blended in a tile, in order: enough to go through its fragments again without finding or sorting
// them.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

#include "large.h"
#include "tile_area.h"

namespace ms {

// The samples of one block that a triangle covers.
struct Piece {
    uint32_t triangle;  // its place in a list of faces
    uint32_t lanes;
};

// What was found in a tile. An entry that waits consists of some pieces, no two of which share a sample.
struct TilePieces {
    static constexpr uint32_t NONE = UINT32_MAX;
    struct Triangle {
        int32_t face;
        uint32_t place;  // in the packed log, or none
    };
    // Vectors are longer than what is in use, so that adding to them needs no check.
    std::vector<Triangle> triangles;
    std::vector<Piece> pieces;
    uint32_t triangle_count = 0, piece_count = 0;

    void make_room(size_t new_triangles, size_t new_pieces) {
        if (triangles.size() < triangle_count + new_triangles)
            triangles.resize(2 * (triangle_count + new_triangles));
        if (pieces.size() < piece_count + new_pieces) pieces.resize(2 * (piece_count + new_pieces));
    }
    void clear() { triangle_count = piece_count = 0; }
};

struct TileLog {
    struct Entry {
        uint32_t first, count;  // of pieces
    };
    // Samples that take their fragments of one entry.
    struct Step {
        uint32_t entry, lanes;
    };
    // Vectors are longer than what is in use, as above.
    struct Block {
        std::vector<Entry> entries;  // of which anything was blended
        std::vector<Step> steps;     // at every sample nearest first
        uint32_t entry_count = 0, step_count = 0;

        void make_room(size_t new_entries) {
            if (entries.size() < entry_count + new_entries) entries.resize(2 * (entry_count + new_entries));
            if (steps.size() < step_count + LANES * new_entries)
                steps.resize(2 * (step_count + LANES * new_entries));
        }
    };
    Block blocks[BLOCKS];

    void clear() {
        for (Block &block : blocks) block.entry_count = block.step_count = 0;
    }
};

// The same with the pieces it refers to, in as little memory as possible.
class PackedLog {
  public:
    // A piece or a step.
    struct Numbered {
        uint16_t low, high, lanes;

        Numbered() = default;
        Numbered(uint32_t number, uint32_t lanes)
            : low((uint16_t)number), high((uint16_t)(number >> 16)), lanes((uint16_t)lanes) {}
        uint32_t number() const { return low | (uint32_t)high << 16; }
    };

    // Into memory that reserve(bytes) gives and that stays the caller's; false where it gives none. Pieces of
    // entries of which nothing was blended are left out.
    template <class Reserve>
    bool pack(const TileLog &log, TilePieces &found, Reserve &&reserve) {
        for (int i = 0; i < BLOCKS; ++i) {
            const TileLog::Block &block = log.blocks[i];
            Ends &end = ends_[i] = i ? ends_[i - 1] : Ends{};
            end.entries += block.entry_count;
            end.steps += block.step_count;
            for (uint32_t j = 0; j < block.entry_count; ++j) end.pieces += block.entries[j].count;
        }
        const Ends &all = ends_[BLOCKS - 1];
        // One more than there can be: each is written before it is known to be another one.
        const size_t most_faces = (size_t)std::min(all.pieces, found.triangle_count) + 1;
        faces_ = (int32_t *)reserve(most_faces * sizeof(int32_t) +
                                    ((size_t)all.pieces + all.steps) * sizeof(Numbered) + all.entries);
        if (!faces_) return false;
        pieces_ = (Numbered *)(faces_ + most_faces);
        steps_ = pieces_ + all.pieces;
        counts_ = (uint8_t *)(steps_ + all.steps);
        face_count_ = 0;
        uint8_t *count = counts_;
        Numbered *piece = pieces_, *step = steps_;
        for (const TileLog::Block &block : log.blocks) {
            for (uint32_t j = 0; j < block.entry_count; ++j) {
                const TileLog::Entry entry = block.entries[j];
                *count++ = (uint8_t)entry.count;
                for (uint32_t k = entry.first; k < entry.first + entry.count; ++k) {
                    // Whether a triangle comes for the first time is hard to predict: no branch.
                    TilePieces::Triangle &triangle = found.triangles[found.pieces[k].triangle];
                    const bool fresh = triangle.place == TilePieces::NONE;
                    triangle.place = fresh ? face_count_ : triangle.place;
                    faces_[face_count_] = triangle.face;
                    face_count_ += fresh;
                    *piece++ = Numbered(triangle.place, found.pieces[k].lanes);
                }
            }
            for (uint32_t j = 0; j < block.step_count; ++j)
                *step++ = Numbered(block.steps[j].entry, block.steps[j].lanes);
        }
        return true;
    }

    // Of the packed log, each once.
    const int32_t *faces() const { return faces_; }
    size_t face_count() const { return face_count_; }
    // What is known of a block. Entries are numbered in the order in which they come first in the steps.
    void entries(int block, std::vector<TileLog::Entry> &out) const {
        const Ends begin = before(block);
        out.resize(ends_[block].entries - begin.entries);
        uint32_t first = 0;
        for (size_t j = 0; j < out.size(); ++j) {
            out[j] = {first, counts_[begin.entries + j]};
            first += out[j].count;
        }
    }
    const Numbered *pieces(int block) const {
        return pieces_ + before(block).pieces;
    }  // number: a place in faces()
    const Numbered *steps(int block) const { return steps_ + before(block).steps; }  // number: an entry's
    int64_t step_count(int block) const { return ends_[block].steps - before(block).steps; }

  private:
    struct Ends {
        uint32_t entries = 0, steps = 0, pieces = 0;  // of this block and those before
    };
    Ends before(int block) const { return block ? ends_[block - 1] : Ends{}; }

    Ends ends_[BLOCKS];
    uint32_t face_count_ = 0;
    int32_t *faces_ = nullptr;
    Numbered *pieces_ = nullptr, *steps_ = nullptr;
    uint8_t *counts_ = nullptr;  // pieces of each entry
};

// The logs of a picture's tiles, as far as they fit a budget of memory; other tiles have to be drawn again.
class PictureLog {
  public:
    PictureLog(int64_t tiles, int64_t budget) : tiles_(tiles), left_(budget) {}

    // Not for one tile by two threads. After the first log that does not fit, nothing is kept any more.
    void keep(int64_t tile, const TileLog &log, TilePieces &found) {
        if (left_ < 0) return;
        auto packed = std::make_unique<PackedLog>();
        if (packed->pack(log, found, [&](size_t bytes) { return reserve(bytes); }))
            tiles_[tile] = std::move(packed);
    }
    const PackedLog *find(int64_t tile) const { return tiles_[tile].get(); }
    bool complete() const {
        for (auto &tile : tiles_)
            if (!tile) return false;
        return true;
    }

  private:
    static constexpr size_t CHUNK = (size_t)2 << 20, ALIGNMENT = 64;

    // Null when the budget is spent.
    unsigned char *reserve(size_t bytes) {
        bytes = (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
        if ((left_ -= (int64_t)bytes) < 0) return nullptr;
        std::lock_guard<std::mutex> lock(guard_);
        if (chunks_.empty() || chunks_.back().size() - used_ < bytes) {
            chunks_.emplace_back(std::max(CHUNK, bytes));
            used_ = 0;
        }
        used_ += bytes;
        return chunks_.back().data() + (used_ - bytes);
    }

    std::vector<std::unique_ptr<PackedLog>> tiles_;
    std::atomic<int64_t> left_;
    std::mutex guard_;  // of what follows
    std::vector<Large<unsigned char>> chunks_;
    size_t used_ = 0;  // of the last one
};

}  // namespace ms
