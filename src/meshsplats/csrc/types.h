// The plain C structures of the interface. Mirrored in rendering/core.py.
#pragma once

#include <cstdint>

extern "C" {

struct MsCamera {
    double world_to_camera[12];  // three rows of four
    double fx, fy, cx, cy;       // pixels
    double near;                 // smallest depth drawn
    int32_t width, height;
};

struct MsOptions {
    int32_t samples;     // an s x s grid of samples in each pixel
    int32_t max_layers;  // 0: all
    int32_t threads;
    float min_transmittance;  // a sample stops once less light than this comes through
    const float *background;  // RGB, one for all or one a pixel
    int32_t background_per_pixel;
};

struct MsMesh {
    int64_t vertex_count, face_count;
    const float *vertices;       // xyz
    const float *colors;         // straight RGBA
    const int32_t *faces;        // three vertex numbers
    const int32_t *face_splat;   // or null
    const int32_t *depth_group;  // or null; numbers below face_count, -1 for none
    const float *normals;        // or null: the faces' own
    const float *attributes;     // attribute_count numbers a vertex, or null
    int32_t attribute_count;
    double filter_px2;  // variance of the low-pass filter of its fans; needs face_splat where it is not 0
};

struct MsSplats {
    int64_t count;
    const float *means;        // xyz
    const float *quaternions;  // wxyz
    const float *scales;
    const float *opacities;
    const float *sh;    // (sh_stored, 3) a splat
    int32_t sh_stored;  // coefficients a channel in the file
    int32_t sh_used;    // coefficients a channel to be used
    int32_t kernel;     // 0: 3dgs, 1: antialiased, 2: 2dgs
    float dilation;     // px^2; 2dgs: variance of the low pass
};

struct MsPicture {
    float *color;       // (h, w, 3) over the background
    float *alpha;       // (h, w)
    float *depth;       // (h, w) or null
    float *normals;     // (h, w, 3) or null
    float *attributes;  // (h, w, attribute_count) or null
    int64_t fragments;  // blended
};

// Gradients of a number with respect to a picture ...
struct MsPictureGradient {
    const float *color;
    const float *alpha;       // or null
    const float *attributes;  // or null
};

// ... and to the vertices: added to what is there.
struct MsVertexGradients {
    float *vertices;    // xyz
    float *colors;      // RGBA
    float *attributes;  // or null
};

}  // extern "C"
