// Where the fields of the interface's structures lie, for Python to compare with its own.
#pragma once

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "adam.h"
#include "edges.h"
#include "fans.h"
#ifndef MS_WIDE_ONLY
#include "cells.h"
#include "consistency.h"
#include "fusion.h"
#include "listing.h"
#include "merging.h"
#include "nearest.h"
#include "ordering.h"
#include "resampling.h"
#include "texture.h"
#include "tsdf.h"
#include "viewer.h"
#endif
#include "shading.h"
#include "ssim.h"
#include "stereo.h"
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

#define MS_FIELD(structure, field)                                                \
    {#structure "." #field, offsetof(structure, field), sizeof(structure::field), \
     kind<decltype(structure::field)>()}

// MS_STRUCT(structure, fields...): the whole, then each field. C++17 has no loop for arguments of macros.
#define MS_1(s, f) MS_FIELD(s, f)
#define MS_2(s, f, ...) MS_FIELD(s, f), MS_1(s, __VA_ARGS__)
#define MS_3(s, f, ...) MS_FIELD(s, f), MS_2(s, __VA_ARGS__)
#define MS_4(s, f, ...) MS_FIELD(s, f), MS_3(s, __VA_ARGS__)
#define MS_5(s, f, ...) MS_FIELD(s, f), MS_4(s, __VA_ARGS__)
#define MS_6(s, f, ...) MS_FIELD(s, f), MS_5(s, __VA_ARGS__)
#define MS_7(s, f, ...) MS_FIELD(s, f), MS_6(s, __VA_ARGS__)
#define MS_8(s, f, ...) MS_FIELD(s, f), MS_7(s, __VA_ARGS__)
#define MS_9(s, f, ...) MS_FIELD(s, f), MS_8(s, __VA_ARGS__)
#define MS_10(s, f, ...) MS_FIELD(s, f), MS_9(s, __VA_ARGS__)
#define MS_11(s, f, ...) MS_FIELD(s, f), MS_10(s, __VA_ARGS__)
#define MS_12(s, f, ...) MS_FIELD(s, f), MS_11(s, __VA_ARGS__)
#define MS_13(s, f, ...) MS_FIELD(s, f), MS_12(s, __VA_ARGS__)
#define MS_14(s, f, ...) MS_FIELD(s, f), MS_13(s, __VA_ARGS__)
#define MS_15(s, f, ...) MS_FIELD(s, f), MS_14(s, __VA_ARGS__)
#define MS_16(s, f, ...) MS_FIELD(s, f), MS_15(s, __VA_ARGS__)
#define MS_17(s, f, ...) MS_FIELD(s, f), MS_16(s, __VA_ARGS__)
#define MS_18(s, f, ...) MS_FIELD(s, f), MS_17(s, __VA_ARGS__)
#define MS_19(s, f, ...) MS_FIELD(s, f), MS_18(s, __VA_ARGS__)
#define MS_20(s, f, ...) MS_FIELD(s, f), MS_19(s, __VA_ARGS__)
#define MS_21(s, f, ...) MS_FIELD(s, f), MS_20(s, __VA_ARGS__)
#define MS_22(s, f, ...) MS_FIELD(s, f), MS_21(s, __VA_ARGS__)
#define MS_23(s, f, ...) MS_FIELD(s, f), MS_22(s, __VA_ARGS__)
#define MS_24(s, f, ...) MS_FIELD(s, f), MS_23(s, __VA_ARGS__)
#define MS_CHOSEN(_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12, _13, _14, _15, _16, _17, _18, _19, _20, \
                  _21, _22, _23, _24, chosen, ...)                                                           \
    chosen
#define MS_STRUCT(structure, ...)                                                                           \
    {#structure, 0, sizeof(structure), 's'},                                                                \
        MS_CHOSEN(__VA_ARGS__, MS_24, MS_23, MS_22, MS_21, MS_20, MS_19, MS_18, MS_17, MS_16, MS_15, MS_14, \
                  MS_13, MS_12, MS_11, MS_10, MS_9, MS_8, MS_7, MS_6, MS_5, MS_4, MS_3, MS_2, MS_1,         \
                  0)(structure, __VA_ARGS__)

constexpr MsField FIELDS[] = {
    MS_STRUCT(MsCamera, world_to_camera, fx, fy, cx, cy, near, width, height),
    MS_STRUCT(MsOptions, samples, max_layers, threads, min_transmittance, background, background_per_pixel,
              cutoff, ramp_slope, ramp_height, ramp_width, ramp_leak),
    MS_STRUCT(MsMesh, vertex_count, face_count, vertices, colors, faces, face_splat, depth_group, normals,
              attributes, attribute_count, by_splat, filter_px2),
    MS_STRUCT(MsSplats, count, means, quaternions, scales, opacities, sh, sh_stored, sh_used, kernel,
              dilation),
    MS_STRUCT(MsImage, color, alpha, depth, normals, attributes, median_depth, fragments),
    MS_STRUCT(MsImageGradients, color, alpha, attributes, expected_weight, target),
    MS_STRUCT(MsVertexGradients, vertices, colors, attributes),
    MS_STRUCT(MsComparison, count, height, width, channels, threads, image, target, mask, gradient, l1_weight,
              ssim_weight, l1, ssim),
    MS_STRUCT(MsAdam, rows, columns, threads, values, mean, square, gradient, scale, chosen, chosen_count,
              mask, step, one_minus_beta1, one_minus_beta2, epsilon, low, high),
    MS_STRUCT(MsFans, count, sides, threads, vertices, polygon, share),
    MS_STRUCT(MsEdges, width, height, samples, threads, vertex_count, face_count, screen, colors, faces,
              across, front, color, gradient, near, cutoff, result),
    MS_STRUCT(MsShading, vertex_count, face_count, splat_count, terms, threads, vertices, colors, faces,
              face_splat, harmonics, eye, shaded, gradient, color_gradient, harmonic_gradient),
    MS_STRUCT(MsViews, cameras, start, count, threads),
    MS_STRUCT(MsMatching, photos, color, matched, photo, sources, range, inverse, along_x, along_y, score,
              source_count, planes, rounds),
#ifndef MS_WIDE_ONLY
    MS_STRUCT(MsFusing, camera, size, low, voxel, center, radius, truncation, behind, depth, sum, weight,
              threads),
    MS_STRUCT(MsTexture, rows, columns, samples, threads, height, width, uv, covered, texels, color, gradient,
              texel_sums, uv_gradient, share, doubt, relaxed),
    MS_STRUCT(MsNearest, count, neighbours, threads, points, order, nearest),
    MS_STRUCT(MsMerging, count, wanted, neighbours, threads, means, covariances, masses, colors, nearest,
              color_weight, group, remaining),
    MS_STRUCT(MsViewer, camera, vertex_count, face_count, vertices, colors, faces, background, cutoffs, color,
              image_count, multisample, culled, threads),
    MS_STRUCT(MsOrdering, vertex_count, face_count, piece_count, vertices, colors, faces, turned, piece_start,
              centers, splat, node, cameras, camera_count, sweeps, threads, max_pairs, rank, pairs, weight,
              before, after),
    MS_STRUCT(MsListing, camera, vertex_count, face_count, vertices, faces, face_splat, copies, starts,
              listed, listed_splat, node_count, threads),
    MS_STRUCT(MsConsistency, views, inverse, others, neighbors, agree, past, seen, tolerance, past_tolerance,
              neighbor_count),
    MS_STRUCT(MsFilling, views, color, inverse, along_x, along_y, known, result, per_pixel),
    MS_STRUCT(MsCarving, views, inverse, points, agree, past, count, tolerance, past_tolerance),
    MS_STRUCT(MsFusion, points, normals, pixels, colors, sure, patches, count, wanted, threads, largest,
              found),
    MS_STRUCT(MsNearestVertices, places, normals, ids, vertices, vertex_normals, index, found, count, size,
              low, side, facing_away, reach, threads),
    MS_STRUCT(MsCellSums, points, cell, beside, middle, values, total, count, around, channels, falloff,
              threads),
    MS_STRUCT(MsResampling, points, bytes, values, result, count, height, width, channels, wraps, threads),
#endif
};

}  // namespace ms
