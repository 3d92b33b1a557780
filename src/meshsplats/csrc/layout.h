// Where the fields of the interface's structures lie, for Python to compare with its own.
#pragma once

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "adam.h"
#include "edges.h"
#include "fans.h"
#ifndef MS_WIDE_ONLY
#include "listing.h"
#include "merging.h"
#include "ordering.h"
#include "viewer.h"
#endif
#include "shading.h"
#include "ssim.h"
#include "types.h"

extern "C" {

struct MsField {
    const char *name;      // STRUCTURE.FIELD, or STRUCTURE for the whole
    int32_t offset, size;  // bytes
    char kind;  // p: pointer, f: floating point, i: integer, s: structure; arrays as their elements
};

}  // extern "C"

namespace ms {

template <class Field>
constexpr char kind() {
    using Element = std::remove_all_extents_t<Field>;
    if (std::is_pointer_v<Element>) return 'p';
    if (std::is_floating_point_v<Element>) return 'f';
    return std::is_integral_v<Element> ? 'i' : 's';
}

#define MS_WHOLE(structure) {#structure, 0, sizeof(structure), 's'}
#define MS_FIELD(structure, field)                                                \
    {#structure "." #field, offsetof(structure, field), sizeof(structure::field), \
     kind<decltype(structure::field)>()}

constexpr MsField FIELDS[] = {
    MS_WHOLE(MsCamera),
    MS_FIELD(MsCamera, world_to_camera),
    MS_FIELD(MsCamera, fx),
    MS_FIELD(MsCamera, fy),
    MS_FIELD(MsCamera, cx),
    MS_FIELD(MsCamera, cy),
    MS_FIELD(MsCamera, near),
    MS_FIELD(MsCamera, width),
    MS_FIELD(MsCamera, height),
    MS_WHOLE(MsOptions),
    MS_FIELD(MsOptions, samples),
    MS_FIELD(MsOptions, max_layers),
    MS_FIELD(MsOptions, threads),
    MS_FIELD(MsOptions, min_transmittance),
    MS_FIELD(MsOptions, background),
    MS_FIELD(MsOptions, background_per_pixel),
    MS_FIELD(MsOptions, cutoff),
    MS_FIELD(MsOptions, ramp_slope),
    MS_FIELD(MsOptions, ramp_height),
    MS_FIELD(MsOptions, ramp_width),
    MS_FIELD(MsOptions, ramp_leak),
    MS_WHOLE(MsMesh),
    MS_FIELD(MsMesh, vertex_count),
    MS_FIELD(MsMesh, face_count),
    MS_FIELD(MsMesh, vertices),
    MS_FIELD(MsMesh, colors),
    MS_FIELD(MsMesh, faces),
    MS_FIELD(MsMesh, face_splat),
    MS_FIELD(MsMesh, depth_group),
    MS_FIELD(MsMesh, normals),
    MS_FIELD(MsMesh, attributes),
    MS_FIELD(MsMesh, attribute_count),
    MS_FIELD(MsMesh, by_splat),
    MS_FIELD(MsMesh, filter_px2),
    MS_WHOLE(MsSplats),
    MS_FIELD(MsSplats, count),
    MS_FIELD(MsSplats, means),
    MS_FIELD(MsSplats, quaternions),
    MS_FIELD(MsSplats, scales),
    MS_FIELD(MsSplats, opacities),
    MS_FIELD(MsSplats, sh),
    MS_FIELD(MsSplats, sh_stored),
    MS_FIELD(MsSplats, sh_used),
    MS_FIELD(MsSplats, kernel),
    MS_FIELD(MsSplats, dilation),
    MS_WHOLE(MsImage),
    MS_FIELD(MsImage, color),
    MS_FIELD(MsImage, alpha),
    MS_FIELD(MsImage, depth),
    MS_FIELD(MsImage, normals),
    MS_FIELD(MsImage, attributes),
    MS_FIELD(MsImage, fragments),
    MS_WHOLE(MsImageGradients),
    MS_FIELD(MsImageGradients, color),
    MS_FIELD(MsImageGradients, alpha),
    MS_FIELD(MsImageGradients, attributes),
    MS_FIELD(MsImageGradients, expected_weight),
    MS_FIELD(MsImageGradients, target),
    MS_WHOLE(MsVertexGradients),
    MS_FIELD(MsVertexGradients, vertices),
    MS_FIELD(MsVertexGradients, colors),
    MS_FIELD(MsVertexGradients, attributes),
    MS_WHOLE(MsComparison),
    MS_FIELD(MsComparison, count),
    MS_FIELD(MsComparison, height),
    MS_FIELD(MsComparison, width),
    MS_FIELD(MsComparison, channels),
    MS_FIELD(MsComparison, threads),
    MS_FIELD(MsComparison, image),
    MS_FIELD(MsComparison, target),
    MS_FIELD(MsComparison, mask),
    MS_FIELD(MsComparison, gradient),
    MS_FIELD(MsComparison, l1_rate),
    MS_FIELD(MsComparison, ssim_rate),
    MS_FIELD(MsComparison, l1),
    MS_FIELD(MsComparison, ssim),
    MS_WHOLE(MsAdam),
    MS_FIELD(MsAdam, rows),
    MS_FIELD(MsAdam, columns),
    MS_FIELD(MsAdam, threads),
    MS_FIELD(MsAdam, values),
    MS_FIELD(MsAdam, mean),
    MS_FIELD(MsAdam, square),
    MS_FIELD(MsAdam, gradient),
    MS_FIELD(MsAdam, scale),
    MS_FIELD(MsAdam, chosen),
    MS_FIELD(MsAdam, chosen_count),
    MS_FIELD(MsAdam, mask),
    MS_FIELD(MsAdam, step),
    MS_FIELD(MsAdam, one_minus_beta1),
    MS_FIELD(MsAdam, one_minus_beta2),
    MS_FIELD(MsAdam, epsilon),
    MS_FIELD(MsAdam, low),
    MS_FIELD(MsAdam, high),
    MS_WHOLE(MsFans),
    MS_FIELD(MsFans, count),
    MS_FIELD(MsFans, sides),
    MS_FIELD(MsFans, threads),
    MS_FIELD(MsFans, vertices),
    MS_FIELD(MsFans, polygon),
    MS_FIELD(MsFans, share),
    MS_WHOLE(MsEdges),
    MS_FIELD(MsEdges, width),
    MS_FIELD(MsEdges, height),
    MS_FIELD(MsEdges, samples),
    MS_FIELD(MsEdges, threads),
    MS_FIELD(MsEdges, vertex_count),
    MS_FIELD(MsEdges, face_count),
    MS_FIELD(MsEdges, screen),
    MS_FIELD(MsEdges, colors),
    MS_FIELD(MsEdges, faces),
    MS_FIELD(MsEdges, beyond),
    MS_FIELD(MsEdges, front),
    MS_FIELD(MsEdges, color),
    MS_FIELD(MsEdges, gradient),
    MS_FIELD(MsEdges, near),
    MS_FIELD(MsEdges, cutoff),
    MS_FIELD(MsEdges, result),
    MS_WHOLE(MsShading),
    MS_FIELD(MsShading, vertex_count),
    MS_FIELD(MsShading, face_count),
    MS_FIELD(MsShading, splat_count),
    MS_FIELD(MsShading, terms),
    MS_FIELD(MsShading, threads),
    MS_FIELD(MsShading, vertices),
    MS_FIELD(MsShading, colors),
    MS_FIELD(MsShading, faces),
    MS_FIELD(MsShading, face_splat),
    MS_FIELD(MsShading, harmonics),
    MS_FIELD(MsShading, eye),
    MS_FIELD(MsShading, shaded),
    MS_FIELD(MsShading, gradient),
    MS_FIELD(MsShading, color_gradient),
    MS_FIELD(MsShading, harmonic_gradient),
#ifndef MS_WIDE_ONLY
    MS_WHOLE(MsNearest),
    MS_FIELD(MsNearest, count),
    MS_FIELD(MsNearest, neighbours),
    MS_FIELD(MsNearest, threads),
    MS_FIELD(MsNearest, points),
    MS_FIELD(MsNearest, order),
    MS_FIELD(MsNearest, nearest),
    MS_WHOLE(MsMerging),
    MS_FIELD(MsMerging, count),
    MS_FIELD(MsMerging, wanted),
    MS_FIELD(MsMerging, neighbours),
    MS_FIELD(MsMerging, threads),
    MS_FIELD(MsMerging, means),
    MS_FIELD(MsMerging, covariances),
    MS_FIELD(MsMerging, masses),
    MS_FIELD(MsMerging, colors),
    MS_FIELD(MsMerging, nearest),
    MS_FIELD(MsMerging, color_weight),
    MS_FIELD(MsMerging, group),
    MS_FIELD(MsMerging, remaining),
    MS_WHOLE(MsViewer),
    MS_FIELD(MsViewer, camera),
    MS_FIELD(MsViewer, vertex_count),
    MS_FIELD(MsViewer, face_count),
    MS_FIELD(MsViewer, vertices),
    MS_FIELD(MsViewer, colors),
    MS_FIELD(MsViewer, faces),
    MS_FIELD(MsViewer, background),
    MS_FIELD(MsViewer, cutoffs),
    MS_FIELD(MsViewer, color),
    MS_FIELD(MsViewer, image_count),
    MS_FIELD(MsViewer, multisample),
    MS_FIELD(MsViewer, culled),
    MS_FIELD(MsViewer, threads),
    MS_WHOLE(MsOrdering),
    MS_FIELD(MsOrdering, vertex_count),
    MS_FIELD(MsOrdering, face_count),
    MS_FIELD(MsOrdering, piece_count),
    MS_FIELD(MsOrdering, vertices),
    MS_FIELD(MsOrdering, colors),
    MS_FIELD(MsOrdering, faces),
    MS_FIELD(MsOrdering, turned),
    MS_FIELD(MsOrdering, piece_start),
    MS_FIELD(MsOrdering, centers),
    MS_FIELD(MsOrdering, splat),
    MS_FIELD(MsOrdering, node),
    MS_FIELD(MsOrdering, cameras),
    MS_FIELD(MsOrdering, camera_count),
    MS_FIELD(MsOrdering, sweeps),
    MS_FIELD(MsOrdering, threads),
    MS_FIELD(MsOrdering, max_pairs),
    MS_FIELD(MsOrdering, rank),
    MS_FIELD(MsOrdering, pairs),
    MS_FIELD(MsOrdering, weight),
    MS_FIELD(MsOrdering, before),
    MS_FIELD(MsOrdering, after),
    MS_WHOLE(MsListing),
    MS_FIELD(MsListing, camera),
    MS_FIELD(MsListing, vertex_count),
    MS_FIELD(MsListing, face_count),
    MS_FIELD(MsListing, vertices),
    MS_FIELD(MsListing, faces),
    MS_FIELD(MsListing, face_splat),
    MS_FIELD(MsListing, copies),
    MS_FIELD(MsListing, starts),
    MS_FIELD(MsListing, listed),
    MS_FIELD(MsListing, listed_splat),
    MS_FIELD(MsListing, node_count),
    MS_FIELD(MsListing, threads),
#endif
};

#undef MS_WHOLE
#undef MS_FIELD

}  // namespace ms
