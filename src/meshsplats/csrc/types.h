// Structures of the C interface, mirrored in _core/structures.py.
#pragma once

#include <cstdint>

extern "C" {

struct MsCamera {
    double world_to_camera[12];  // 3 x 4, row-major
    double fx, fy, cx, cy;       // pixels
    double near;                 // depth of the near plane, > 0
    int32_t width, height;       // pixels
};

struct MsOptions {
    int32_t samples;     // a grid of samples x samples in each pixel, 1 to 16
    int32_t max_layers;  // blend at most the nearest max_layers fragments of a sample; 0: no limit
    int32_t threads;
    float min_transmittance;  // early termination: a sample stops below this transmittance
    const float *background;  // RGB: 3 values, or (height, width, 3)
    int32_t background_per_pixel;
    float cutoff;  // meshes: fragments of at least this opacity are opaque, others not drawn; negative: as is
    // With a cutoff, see ramp.h:
    float ramp_slope;   // greatest slope of a ramp in place of the hard cut; 0: none
    float ramp_height;  // opacity at the cutoff
    float ramp_width;   // least width of the ramp in samples; 0: any
    float ramp_leak;    // derivative where the ramp is 0 or 1
};

struct MsMesh {
    int64_t vertex_count, face_count;
    const float *vertices;       // (vertex_count, 3) world space
    const float *colors;         // (vertex_count, 4) straight RGBA
    const int32_t *faces;        // (face_count, 3) vertex indices
    const int32_t *face_splat;   // (face_count,) splat of each face, or null
    const int32_t *depth_group;  // (face_count,) below face_count, -1: no group; or null
    const float *normals;        // (vertex_count, 3), or null: the faces' own normals
    const float *attributes;     // (vertex_count, attribute_count), or null
    int32_t attribute_count;
    // 1: whole splats in the order of their centres' depths, which needs face_splat; 2: triangles as they are
    // listed, the last in front. Without a cutoff.
    int32_t by_splat;
    double filter_px2;  // variance of the fans' low-pass filter in square pixels; > 0 needs face_splat
};

struct MsSplats {
    int64_t count;
    const float *means;        // (count, 3) world space
    const float *quaternions;  // (count, 4) unit, wxyz
    const float *scales;       // (count, 3) standard deviations
    const float *opacities;    // (count,)
    const float *sh;           // (count, sh_stored, 3) spherical harmonics
    int32_t sh_stored;         // stored coefficients per channel
    int32_t sh_used;           // coefficients to evaluate: 1, 4, 9 or 16, at most sh_stored
    int32_t kernel;            // 0: 3dgs, 1: antialiased, 2: 2dgs
    float dilation;            // low-pass variance in square pixels
};

struct MsImage {
    float *color;         // (height, width, 3) over the background
    float *alpha;         // (height, width)
    float *depth;         // (height, width), or null
    float *normals;       // (height, width, 3), or null
    float *attributes;    // (height, width, attribute_count), or null
    float *median_depth;  // (height, width): where half of the light is stopped, else infinite; or null
    int64_t fragments;    // out: number of blended fragments
};

// Gradients of a loss with respect to an image.
struct MsImageGradients {
    const float *color;       // (height, width, 3)
    const float *alpha;       // (height, width), or null
    const float *attributes;  // (height, width, attribute_count), or null
    // The loss also has sum_k T_k a_k |c_k - target|^2, the expected square error of an image in which each
    // fragment is opaque by a chance of a_k, times this weight:
    const float *expected_weight;  // (height, width), or null
    const float *target;           // (height, width, 3), or null
};

// Gradients of a loss with respect to the vertices. The core adds to the arrays.
struct MsVertexGradients {
    float *vertices;    // (vertex_count, 3)
    float *colors;      // (vertex_count, 4)
    float *attributes;  // (vertex_count, attribute_count), or null
};

}  // extern "C"
