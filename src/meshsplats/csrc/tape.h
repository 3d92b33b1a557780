// The tape of the forward pass: for every tile, the fragments in blend order. The backward pass replays it
// without rasterizing or sorting again.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

#include "pooled_vector.h"
#include "tile_area.h"

namespace ms {

// The samples of one block that one triangle covers.
struct CoverageMask {
    uint32_t triangle;  // index in a list of triangles
    LaneMask lanes;
};

// The triangles of a tile and their coverage masks. A queue entry refers to a range of masks that share no
// sample. Vectors only grow; the counts say what is in use, so that appending needs no check.
struct TileCoverage {
    static constexpr uint32_t NOT_PACKED = UINT32_MAX;
    struct Triangle {
        int32_t face;
        uint32_t packed_index;  // in PackedTape::faces(), or NOT_PACKED
    };
    std::vector<Triangle> triangles;
    std::vector<CoverageMask> masks;
    uint32_t triangle_count = 0, mask_count = 0;

    // Makes room to append this many triangles and masks.
    void reserve(size_t new_triangles, size_t new_masks) {
        if (triangles.size() < triangle_count + new_triangles)
            triangles.resize(2 * (triangle_count + new_triangles));
        if (masks.size() < mask_count + new_masks) masks.resize(2 * (mask_count + new_masks));
    }
    // Returns the index of the triangle.
    uint32_t add_triangle(int32_t face) {
        MS_ASSERT(triangle_count < triangles.size());
        triangles[triangle_count] = {face, NOT_PACKED};
        return triangle_count++;
    }
    void add_mask(uint32_t triangle, LaneMask lanes) {
        MS_ASSERT(mask_count < masks.size() && triangle < triangle_count && lanes);
        masks[mask_count++] = {triangle, lanes};
    }
    void clear() { triangle_count = mask_count = 0; }
};

// A queue entry of which any fragment was blended.
struct TapeEntry {
    uint32_t first_mask, mask_count;
};

// The tape of one tile during its forward pass.
struct TileTape {
    // One call of `emit`: these lanes blend their fragment of this entry.
    struct Step {
        uint32_t entry;
        LaneMask lanes;
    };
    // Vectors only grow, as in TileCoverage.
    struct Block {
        std::vector<TapeEntry> entries;  // in the order of their first steps
        std::vector<Step> steps;         // at every sample front to back
        uint32_t entry_count = 0, step_count = 0;

        // Makes room for new entries, each of which takes at most one step per lane.
        void reserve(size_t new_entries) {
            if (entries.size() < entry_count + new_entries) entries.resize(2 * (entry_count + new_entries));
            if (steps.size() < step_count + LANES * new_entries)
                steps.resize(2 * (step_count + LANES * new_entries));
        }
        // Returns the index of the entry.
        uint32_t add_entry(uint32_t first_mask, uint32_t mask_count) {
            MS_ASSERT(entry_count < entries.size() && mask_count >= 1 && mask_count <= LANES);
            entries[entry_count] = {first_mask, mask_count};
            return entry_count++;
        }
        void add_step(uint32_t entry, LaneMask lanes) {
            MS_ASSERT(step_count < steps.size() && entry < entry_count && lanes && lanes <= ALL_LANES);
            steps[step_count++] = {entry, lanes};
        }
    };
    Block blocks[MAX_BLOCKS];

    void clear() {
        for (Block &block : blocks) block.entry_count = block.step_count = 0;
    }
};

// A 32-bit index and a LaneMask in 6 bytes.
struct IndexedLanes {
    uint16_t low, high, lanes;

    IndexedLanes() = default;
    IndexedLanes(uint32_t index, LaneMask lanes)
        : low((uint16_t)index), high((uint16_t)(index >> 16)), lanes((uint16_t)lanes) {
        MS_ASSERT(lanes <= ALL_LANES);
    }
    uint32_t index() const { return low | (uint32_t)high << 16; }
};

// The tape of one tile in the order of the splats, where every entry is blended whole and at once: its masks
// need no steps and are in their final form. Vectors only grow.
struct SplatTape {
    static constexpr uint32_t NO_INDEX = UINT32_MAX;
    struct Block {
        std::vector<IndexedLanes> masks;   // index: in faces
        std::vector<uint8_t> mask_counts;  // of each entry
        uint32_t mask_count = 0, entry_count = 0;
        uint32_t room = 0;  // for masks, and for as many entries

        // Makes room for some masks.
        void reserve(uint32_t more) {
            if (mask_count + more <= room) return;
            room = 2 * (mask_count + more);
            masks.resize(room);
            mask_counts.resize(room);
        }
        void add_entry(uint32_t masks_of_entry) {
            MS_ASSERT(entry_count < room && masks_of_entry >= 1 && masks_of_entry <= LANES);
            mask_counts[entry_count++] = (uint8_t)masks_of_entry;
        }
    };
    std::vector<int32_t> faces;  // in the order of their first masks
    uint32_t face_count = 0;
    Block blocks[MAX_BLOCKS];

    // Makes room for some faces, and for one that add_mask writes in vain.
    void reserve_faces(size_t more) {
        if (faces.size() <= face_count + more) faces.resize(2 * (face_count + more) + 1);
    }
    // Appends the mask of a face with that index, which it gets if it has NO_INDEX. Branch-free, because that
    // is unpredictable.
    void add_mask(int block, int32_t face, uint32_t &index, LaneMask lanes) {
        Block &b = blocks[block];
        MS_ASSERT(lanes && b.mask_count < b.room && face_count < faces.size());
        const bool is_new = index == NO_INDEX;
        index = is_new ? face_count : index;
        faces[face_count] = face;
        face_count += is_new;
        b.masks[b.mask_count++] = IndexedLanes(index, lanes);
    }
    void clear() {
        face_count = 0;
        for (Block &b : blocks) b.mask_count = b.entry_count = 0;
    }
};

// A TileTape and its coverage masks, or a SplatTape, packed into one allocation that the caller owns.
class PackedTape {
  public:
    // Packs into the memory that allocate(bytes) returns, aligned for int32_t; false if that is null. Masks
    // of entries that are not on the tape are left out. Sets packed_index of the triangles that are on it.
    template <class Allocate>
    bool pack(const TileTape &tape, TileCoverage &coverage, Allocate &&allocate) {
        for (int i = 0; i < MAX_BLOCKS; ++i) {
            const TileTape::Block &block = tape.blocks[i];
            Ends &end = ends_[i] = i ? ends_[i - 1] : Ends{};
            end.entries += block.entry_count;
            end.steps += block.step_count;
            for (uint32_t j = 0; j < block.entry_count; ++j) end.masks += block.entries[j].mask_count;
        }
        const Ends &total = ends_[MAX_BLOCKS - 1];
        // One more than there can be, because pack_mask writes the slot behind the last face.
        const size_t max_faces = (size_t)std::min(total.masks, coverage.triangle_count) + 1;
        faces_ =
            (int32_t *)allocate(max_faces * sizeof(int32_t) +
                                ((size_t)total.masks + total.steps) * sizeof(IndexedLanes) + total.entries);
        if (!faces_) return false;
        masks_ = (IndexedLanes *)(faces_ + max_faces);
        steps_ = masks_ + total.masks;
        mask_counts_ = (uint8_t *)(steps_ + total.steps);
        face_count_ = 0;
        uint8_t *mask_count = mask_counts_;
        IndexedLanes *mask = masks_, *step = steps_;
        for (const TileTape::Block &block : tape.blocks) {
            for (uint32_t j = 0; j < block.entry_count; ++j) {
                const TapeEntry entry = block.entries[j];
                MS_ASSERT(entry.first_mask + entry.mask_count <= coverage.mask_count);
                *mask_count++ = (uint8_t)entry.mask_count;
                for (uint32_t k = entry.first_mask; k < entry.first_mask + entry.mask_count; ++k)
                    *mask++ = pack_mask(coverage.masks[k], coverage.triangles[coverage.masks[k].triangle]);
            }
            for (uint32_t j = 0; j < block.step_count; ++j)
                *step++ = IndexedLanes(block.steps[j].entry, block.steps[j].lanes);
        }
        MS_ASSERT(face_count_ < max_faces);
        return true;
    }

    // Likewise; without steps.
    template <class Allocate>
    bool pack(const SplatTape &tape, Allocate &&allocate) {
        for (int i = 0; i < MAX_BLOCKS; ++i) {
            Ends &end = ends_[i] = i ? ends_[i - 1] : Ends{};
            end.entries += tape.blocks[i].entry_count;
            end.masks += tape.blocks[i].mask_count;
        }
        const Ends &total = ends_[MAX_BLOCKS - 1];
        face_count_ = tape.face_count;
        const size_t face_bytes = face_count_ * sizeof(int32_t),
                     mask_bytes = total.masks * sizeof(IndexedLanes);
        unsigned char *memory = (unsigned char *)allocate(face_bytes + mask_bytes + total.entries);
        if (!memory) return false;
        faces_ = (int32_t *)memory;
        masks_ = steps_ = (IndexedLanes *)(memory + face_bytes);
        mask_counts_ = memory + face_bytes + mask_bytes;
        std::copy_n(tape.faces.data(), face_count_, faces_);
        IndexedLanes *mask = masks_;
        uint8_t *mask_count = mask_counts_;
        for (const SplatTape::Block &block : tape.blocks) {
            mask = std::copy_n(block.masks.data(), block.mask_count, mask);
            mask_count = std::copy_n(block.mask_counts.data(), block.entry_count, mask_count);
        }
        return true;
    }

    // The faces on the tape, each once, in the order of their first masks.
    const int32_t *faces() const { return faces_; }
    size_t face_count() const { return face_count_; }

    // The entries of a block, in the order of their first steps. Their masks are indices into masks(block).
    void entries(int block, std::vector<TapeEntry> &out) const {
        const Ends begin = begin_of(block);
        out.resize(ends_[block].entries - begin.entries);
        uint32_t first = 0;
        for (size_t j = 0; j < out.size(); ++j) {
            out[j] = {first, mask_counts_[begin.entries + j]};
            first += out[j].mask_count;
        }
    }
    const IndexedLanes *masks(int block) const {
        return masks_ + begin_of(block).masks;
    }  // index: in faces()
    const IndexedLanes *steps(int block) const {
        return steps_ + begin_of(block).steps;
    }  // index: of an entry
    int64_t step_count(int block) const { return ends_[block].steps - begin_of(block).steps; }

  private:
    struct Ends {
        uint32_t entries = 0, steps = 0, masks = 0;
    };
    Ends begin_of(int block) const {
        MS_ASSERT(block >= 0 && block < MAX_BLOCKS);
        return block ? ends_[block - 1] : Ends{};
    }

    // Appends the face if it is new. Branch-free, because that is unpredictable.
    IndexedLanes pack_mask(const CoverageMask &mask, TileCoverage::Triangle &triangle) {
        const bool is_new = triangle.packed_index == TileCoverage::NOT_PACKED;
        triangle.packed_index = is_new ? face_count_ : triangle.packed_index;
        faces_[face_count_] = triangle.face;
        face_count_ += is_new;
        return IndexedLanes(triangle.packed_index, mask.lanes);
    }

    Ends ends_[MAX_BLOCKS];  // of each block in the arrays below
    uint32_t face_count_ = 0;
    int32_t *faces_ = nullptr;
    IndexedLanes *masks_ = nullptr, *steps_ = nullptr;
    uint8_t *mask_counts_ = nullptr;  // of each entry
};

// The tapes of an image's tiles within a memory budget. Tiles without a tape must be rendered again in the
// backward pass. Thread-safe, except for one tile from two threads.
class Tape {
  public:
    Tape(int64_t tiles, int64_t budget) : tiles_(tiles), budget_left_(budget) {}

    // Takes pack(packed, allocate), which packs the tape of the tile. After the first tape that exceeds the
    // budget, nothing more is recorded.
    template <class Pack>
    void record(int64_t tile, Pack &&pack) {
        MS_ASSERT(tile >= 0 && tile < (int64_t)tiles_.size() && !tiles_[tile]);
        if (budget_left_ < 0) return;
        auto packed = std::make_unique<PackedTape>();
        if (pack(*packed, [&](size_t bytes) { return allocate(bytes); })) tiles_[tile] = std::move(packed);
    }
    // Null if the tile has no tape.
    const PackedTape *find(int64_t tile) const {
        MS_ASSERT(tile >= 0 && tile < (int64_t)tiles_.size());
        return tiles_[tile].get();
    }
    bool complete() const {
        for (auto &tile : tiles_)
            if (!tile) return false;
        return true;
    }

  private:
    static constexpr size_t CHUNK_BYTES = (size_t)2 << 20, ALIGNMENT = 64;

    // Bump allocation; null when the budget is spent.
    unsigned char *allocate(size_t bytes) {
        bytes = (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
        if ((budget_left_ -= (int64_t)bytes) < 0) return nullptr;
        std::lock_guard<std::mutex> lock(mutex_);
        if (chunks_.empty() || chunks_.back().size() - used_ < bytes) {
            chunks_.emplace_back(std::max(CHUNK_BYTES, bytes));
            used_ = 0;
        }
        used_ += bytes;
        MS_ASSERT(used_ <= chunks_.back().size());
        return chunks_.back().data() + (used_ - bytes);
    }

    std::vector<std::unique_ptr<PackedTape>> tiles_;
    std::atomic<int64_t> budget_left_;  // bytes
    std::mutex mutex_;                  // guards chunks_ and used_
    std::vector<PooledVector<unsigned char>> chunks_;
    size_t used_ = 0;  // bytes of the last chunk
};

}  // namespace ms
