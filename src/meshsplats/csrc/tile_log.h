// What was blended in a tile, in order: enough to go through its fragments again without finding or sorting them.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <vector>

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
    std::vector<Triangle> triangles;
    std::vector<Piece> pieces;

    void clear() {
        triangles.clear();
        pieces.clear();
    }
};

struct TileLog {
    struct Entry {
        uint32_t first, count;  // of pieces
    };
    // Samples that take their fragments of one entry.
    struct Step {
        uint32_t entry, lanes;
    };
    // Vectors are longer than what is in use, so that adding to them needs no check.
    struct Block {
        std::vector<Entry> entries;  // of which anything was blended
        std::vector<Step> steps;     // at every sample nearest first
        uint32_t entry_count = 0, step_count = 0;

        void make_room(size_t new_entries) {
            if (entries.size() < entry_count + new_entries) entries.resize(2 * (entry_count + new_entries));
            if (steps.size() < step_count + LANES * new_entries) steps.resize(2 * (step_count + LANES * new_entries));
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
    // Pieces of entries of which nothing was blended are left out.
    void pack(const TileLog &log, TilePieces &found) {
        size_t entry_count = 0, step_count = 0, piece_count = 0;
        for (int i = 0; i < BLOCKS; ++i) {
            const TileLog::Block &block = log.blocks[i];
            entry_count += block.entry_count;
            step_count += block.step_count;
            for (uint32_t j = 0; j < block.entry_count; ++j) piece_count += block.entries[j].count;
            ends_[i] = {(uint32_t)entry_count, (uint32_t)step_count, (uint32_t)piece_count};
        }
        counts_.reset(new uint8_t[entry_count]);
        pieces_.reset(new Numbered[piece_count]);
        steps_.reset(new Numbered[step_count]);
        faces_.resize(std::min(piece_count, found.triangles.size()) + 1);
        uint32_t face_count = 0;
        uint8_t *count = counts_.get();
        Numbered *piece = pieces_.get(), *step = steps_.get();
        for (const TileLog::Block &block : log.blocks) {
            for (uint32_t j = 0; j < block.entry_count; ++j) {
                const TileLog::Entry entry = block.entries[j];
                *count++ = (uint8_t)entry.count;
                for (uint32_t k = entry.first; k < entry.first + entry.count; ++k) {
                    // Whether a triangle comes for the first time is hard to predict: no branch.
                    TilePieces::Triangle &triangle = found.triangles[found.pieces[k].triangle];
                    const bool fresh = triangle.place == TilePieces::NONE;
                    triangle.place = fresh ? face_count : triangle.place;
                    faces_[face_count] = triangle.face;
                    face_count += fresh;
                    *piece++ = Numbered(triangle.place, found.pieces[k].lanes);
                }
            }
            for (uint32_t j = 0; j < block.step_count; ++j) *step++ = Numbered(block.steps[j].entry, block.steps[j].lanes);
        }
        faces_.resize(face_count);
    }

    const std::vector<int32_t> &faces() const { return faces_; }
    // What is known of a block; of pieces, `triangle` is a place in faces().
    void unpack(int i, std::vector<TileLog::Entry> &entries, std::vector<Piece> &pieces, std::vector<TileLog::Step> &steps) const {
        const Ends begin = i ? ends_[i - 1] : Ends{}, end = ends_[i];
        entries.resize(end.entries - begin.entries);
        uint32_t first = 0;
        for (size_t j = 0; j < entries.size(); ++j) {
            entries[j] = {first, counts_[begin.entries + j]};
            first += entries[j].count;
        }
        pieces.resize(end.pieces - begin.pieces);
        for (size_t j = 0; j < pieces.size(); ++j) pieces[j] = {pieces_[begin.pieces + j].number(), pieces_[begin.pieces + j].lanes};
        steps.resize(end.steps - begin.steps);
        for (size_t j = 0; j < steps.size(); ++j) steps[j] = {steps_[begin.steps + j].number(), steps_[begin.steps + j].lanes};
    }

    int64_t bytes() const {
        const Ends &all = ends_[BLOCKS - 1];
        return (int64_t)(faces_.capacity() * sizeof(int32_t) + all.entries + (all.pieces + (size_t)all.steps) * sizeof(Numbered));
    }

  private:
    struct Numbered {
        uint16_t low, high, lanes;

        Numbered() = default;
        Numbered(uint32_t number, uint32_t lanes) : low((uint16_t)number), high((uint16_t)(number >> 16)), lanes((uint16_t)lanes) {}
        uint32_t number() const { return low | (uint32_t)high << 16; }
    };
    struct Ends {
        uint32_t entries, steps, pieces;  // of this block and those before
    };
    std::vector<int32_t> faces_;
    std::unique_ptr<uint8_t[]> counts_;  // pieces of each entry
    std::unique_ptr<Numbered[]> pieces_, steps_;
    Ends ends_[BLOCKS];
};

// The logs of a picture's tiles, as far as they fit a budget of memory; other tiles have to be drawn again.
class PictureLog {
  public:
    PictureLog(int64_t tiles, int64_t budget) : tiles_(tiles), left_(budget) {}

    // Not for one tile by two threads. After the first log that does not fit, nothing is kept any more.
    void keep(int64_t tile, const TileLog &log, TilePieces &found) {
        if (left_ < 0) return;
        auto packed = std::make_unique<PackedLog>();
        packed->pack(log, found);
        if ((left_ -= packed->bytes()) >= 0) tiles_[tile] = std::move(packed);
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
