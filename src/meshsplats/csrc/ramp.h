// The opacity of meshes that are drawn with a cutoff: a hard cut, or a ramp in its place while a mesh is
// optimised.
//
// With a the interpolated opacity and |grad a| its slope in the image, per sample, the ramp is
//     a' = clamp(h + (a - c) k, 0, 1),  k = min(k_max, 1 / (w |grad a|)).
// With h = 1/2 and a large k_max it is the share of a pixel, w samples wide, that lies within the level set
// a = c. The backward pass takes k for constant: its derivative has the factor a - c, which is 0 on the level
// set.
#pragma once

#include <cmath>

#include "lanes.h"
#include "types.h"

namespace ms {

inline bool has_cutoff(const MsOptions &options) { return options.cutoff >= 0; }
inline bool has_ramp(const MsOptions &options) { return has_cutoff(options) && options.ramp_slope > 0; }

struct Ramp {
    Lanes opacity;  // a'
    Lanes slope;    // da'/da; ramp_leak where a' is 0 or 1
};

inline Ramp opacity_ramp(const MsOptions &options, const Lanes &a, const Lanes &gradient_x,
                         const Lanes &gradient_y) {
    Lanes slope = broadcast(options.ramp_slope);
    if (options.ramp_width > 0) {
        alignas(64) float length[LANES];
        store_lanes(length, gradient_x * gradient_x + gradient_y * gradient_y);
        for (int i = 0; i < LANES; ++i) length[i] = std::sqrt(length[i]);
        const Lanes width = max_lanes(broadcast(options.ramp_width) * load_lanes(length), broadcast(1e-20f));
        slope = min_lanes(slope, broadcast(1) / width);
    }
    const Lanes value = broadcast(options.ramp_height) + (a - broadcast(options.cutoff)) * slope;
    const Lanes opacity = clamp(value, broadcast(0), broadcast(1));
    const LaneMask between = greater(opacity, broadcast(0)) & greater(broadcast(1), opacity);
    return {opacity, select(between, slope, broadcast(options.ramp_leak))};
}

}  // namespace ms
