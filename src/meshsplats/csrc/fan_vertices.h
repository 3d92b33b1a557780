// The vertices of the fans of a mesh, fan by fan.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "check.h"
#include "types.h"

namespace ms {

struct SharedVertices : std::runtime_error {
    SharedVertices() : std::runtime_error("two splats share a vertex") {}
};

// The vertices of all fans in one list, fan by fan. A slot is a position in this list: fan i has the faces
// [faces[i], faces[i + 1]) and the slots [slots[i], slots[i + 1]). Where the vertices of each fan follow
// those of the fan before, as conversion makes them, the list is that of the vertices itself; it may then
// include a few vertices of no face.
class FanVertices {
  public:
    std::vector<int32_t> faces, slots;

    explicit FanVertices(const MsMesh &mesh) {
        MS_ASSERT(mesh.face_splat && mesh.vertex_count <= INT32_MAX);
        faces.reserve(mesh.face_count / 6 + 2);
        slots.reserve(faces.capacity());
        if (!list_in_order(mesh)) list_in_any_order(mesh);
    }
    int32_t fan_count() const { return (int32_t)faces.size() - 1; }
    int32_t slot(int32_t vertex) const { return slot_of_vertex_.empty() ? vertex : slot_of_vertex_[vertex]; }
    int32_t vertex(int32_t slot) const { return vertex_of_slot_.empty() ? slot : vertex_of_slot_[slot]; }

  private:
    // False if a fan has a vertex below the last one of the fans before, or if many vertices are of no face.
    bool list_in_order(const MsMesh &mesh) {
        constexpr int64_t MAX_VERTICES = 12;  // of a fan, for each of its triangles
        int64_t end = 0;                      // vertices up to here are of the fans before
        bool in_order = true;
        for (int64_t i = 0; i < mesh.face_count;) {
            faces.push_back((int32_t)i);
            slots.push_back((int32_t)end);
            int32_t least = INT32_MAX, most = -1;
            const int32_t splat = mesh.face_splat[i];
            for (; i < mesh.face_count && mesh.face_splat[i] == splat; ++i) {
                const int32_t *f = mesh.faces + 3 * i;
                for (int k = 0; k < 3; ++k) MS_ASSERT(f[k] >= 0 && f[k] < mesh.vertex_count);
                least = std::min(least, std::min(f[0], std::min(f[1], f[2])));
                most = std::max(most, std::max(f[0], std::max(f[1], f[2])));
            }
            in_order &= (least >= end) & (most - end < MAX_VERTICES * (i - faces.back()));
            end = (int64_t)most + 1;
        }
        faces.push_back((int32_t)mesh.face_count);
        slots.push_back((int32_t)end);
        return in_order;
    }
    void list_in_any_order(const MsMesh &mesh) {
        slots.clear();
        slot_of_vertex_.assign(mesh.vertex_count, -1);
        vertex_of_slot_.reserve(std::min(mesh.vertex_count, 3 * mesh.face_count));
        for (int32_t fan = 0; fan < fan_count(); ++fan) {
            const int32_t first = (int32_t)vertex_of_slot_.size();
            slots.push_back(first);
            for (int64_t i = 3 * (int64_t)faces[fan]; i < 3 * (int64_t)faces[fan + 1]; ++i) {
                int32_t &slot = slot_of_vertex_[mesh.faces[i]];
                if (slot >= 0 && slot < first) throw SharedVertices();
                if (slot >= 0) continue;
                slot = (int32_t)vertex_of_slot_.size();
                vertex_of_slot_.push_back(mesh.faces[i]);
            }
        }
        slots.push_back((int32_t)vertex_of_slot_.size());
    }

    // Empty where a slot is a vertex.
    std::vector<int32_t> slot_of_vertex_, vertex_of_slot_;
};

}  // namespace ms
